"""A model's functions compiled to batched arithmetic: traced, simplified, evaluated for many runs.

Only `jaxekf.filtering` imports it; `lowered_function` is the entry. "Lanes" are the batch axis, the last
axis of every array. A primitive of JAX gets its batching rule in `lanes` and its sparsity rule in
`sparsity`; a closed-form derivative of a rotation goes into `group_derivative`.
"""
