"""JSON documents of result folders, tuned folders, alignments and checks, as typed structures of `msgspec`.

`codec` reads and writes them; each other module holds the structures of one file. A new document is one
module here, with a structure that begins with `codec.Document`.
"""
