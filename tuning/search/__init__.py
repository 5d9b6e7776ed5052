"""How a tuning searches: descent with L-BFGS, Fisher scoring or optax, minibatches, several starts.

`optimisers` has the objects a user passes. A new optimiser is a class there and its step in `descent`.
"""
