"""Objectives: errors against the truth, likelihood and priors; and the Fisher information at a minimum.

A new objective is a term in `objectives`; `data` holds the runs on the device.
"""
