"""One module for each kind of recording; each holds a `LOADER` and is found by itself."""
