"""One module a file format: bytes to a `pipeline.readers.frame.Frame`."""
