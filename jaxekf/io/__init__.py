"""Files: recorded runs as folders and as single files, exports, and readers of other programs' files.

`load`, `save`, `register`, `read_export`, `schema` and `importers` are public. A new format of another
program goes into `importers`; a new stream is one file in `streams`, with its `StreamSchema`; a new
unit is an entry in `units`; a new entry of every stream's section goes into `_section_entries`.
"""

from jaxekf._support.lazy import attributes, names_of

__getattr__, __dir__ = attributes(
    __name__,
    names_of("jaxekf.io.export", "read_export")
    | names_of("jaxekf.io.run_folder", "load", "load_imu", "save")
    | names_of("jaxekf.io.streams", "register"),
)
