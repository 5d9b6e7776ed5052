"""Foundations without knowledge of filtering: errors, lazy imports, compilation, memory, quantiles.

Every room may import from here, and this room imports none. A user finds `JaxekfError` and its kinds,
`jit`, `set_up` and `keep_programs` in `jaxekf` itself. Add here only what several rooms need and none
of them owns.
"""
