"""A recorded run in memory: its streams, what was masked and why, its gaps and its truth.

`types` has the streams and `Recording`; `screening` decides which samples are valid; `accounts` counts
what became of every row. A new stream that a model of one's own reads needs no change here: see
`jaxekf.io.streams`.
"""
