"""`python -m jaxslam` is the command `jaxslam`."""

from jaxslam.cli.entry_point import main

if __name__ == "__main__":
    main()
