"""Support without filtering: errors, lazy imports, compilation, memory, deprecated names, chi-square.

Every package may import from here, and this package imports none of them. Users import `JaxekfError` and
its subclasses, `jit`, `set_up` and `keep_programs` from `jaxekf`. A file belongs here only if several
packages need it and none of them owns it.
"""
