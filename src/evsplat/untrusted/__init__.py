"""Readers of files that strangers may have made: text, arrays, pickles, pictures, videos, HDF5.

No other module calls the libraries that parse them (`tests/untrusted/test_only_callers.py`). What
a reader here gives is whole; everything that can be wrong with a file is an `EvsplatError` of one
sentence. No file runs code, names another file, or takes memory that its own size does not justify.
"""
