"""Files: recorded runs as folders and as single files, exports, and readers of other programs' files.

`load`, `save`, `register`, `read_export`, `schema` and `importers` are public. A new format of another
program goes into `importers`; a new stream is one file in `streams`, with its `StreamSchema`; a new
unit is an entry in `units`; a new entry of every stream's section goes into `_section_entries`.
"""

from jaxekf._support.lazy import attributes

__getattr__, __dir__ = attributes(
    __name__,
    {
        "jaxekf.io.export": ("read_export",),
        "jaxekf.io.run_folder": ("load", "load_imu", "save"),
        "jaxekf.io.streams": ("register",),
    },
)
