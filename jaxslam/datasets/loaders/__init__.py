"""Loaders, one module for each kind of recording; each module that defines a `LOADER` is registered automatically."""
