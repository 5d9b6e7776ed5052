"""Comparisons of tunings: before and after, held-out folds, baselines, and the work of each.

Only the command line imports this room. A new baseline goes into `baselines`.
"""
