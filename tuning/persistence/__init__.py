"""What a tuning leaves on disk: checkpoints of a search and of folds, and `tuning.json` for the report.

A new warning about a tuning goes into `_tuning_warnings`.
"""
