"""Files of a tuning: parameters, `tuning.json` for the report, and checkpoints of a search and of folds.

`tuning_folder` saves a tuning and `checkpoint` a search; other rooms import these, `tuning_document` and
`fold_checkpoint`. A new warning about a tuning goes into `_tuning_warnings`.
"""
