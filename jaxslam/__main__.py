"""`python -m jaxslam` is the command `jaxslam`."""

from jaxslam.cli import main

if __name__ == "__main__":
    main()
