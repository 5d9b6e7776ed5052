"""Files: recorded runs as folders and as single files, exports, and readers of other programs' files.

`load` and `save` are public, as are `read_export` and `importers`. A new format of other programs goes into
`importers`; a new stream is one file in this room with its `StreamSchema`.
"""

from jaxekf._support.lazy import attributes

__getattr__, __dir__ = attributes(
    __name__,
    {"jaxekf.io.run_folder": ("load", "load_imu", "save"), "jaxekf.io.export": ("read_export",)},
)
