"""Tunings against other tunings: before and after, held-out folds, baselines, and what each of them cost.

A new baseline goes into `baselines`.
"""
