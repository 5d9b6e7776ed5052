"""What a tuning minimises: errors against the truth, likelihood, priors; and the information at its
minimum.

A new objective is a term in `objectives`; `data` holds the runs on the device.
"""
