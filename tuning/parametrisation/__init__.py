"""Q, R and calibration as one vector of free numbers, and which of them are free.

`free_vector` maps parameters to that vector and back, `leaf` one parameter of them; `free_toml` reads which
are free from a file; `truth_frame` is the encoder's own frame. A new kind of prior goes into `free_vector`.
"""
