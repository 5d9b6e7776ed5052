"""Results of tunings, searches, comparisons and cross-validations as plain data, without files or a search.

Every other room may import from here except `parametrisation` and `objective`. A new kind of result is a
file of its own; `tuning.persistence` writes it.
"""
