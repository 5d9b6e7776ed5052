"""Searches for the best parameters: L-BFGS, Fisher scoring, optax, minibatches, several starts, and
searches without gradients.

`tuning.tuner` and `tuning.persistence` import `evaluation`, `descent`, `multistart`, `optimisers` and
`derivative_free`. A new optimiser is a class in `optimisers`.
"""
