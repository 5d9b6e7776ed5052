"""A model's functions made into batched arithmetic: traced, sparse, side by side for many instants and
runs.

Only `jaxekf.filtering` imports it. A primitive of JAX gets its rule in `lanes`; a closed-form
derivative of a rotation goes into `group_derivative`.
"""
