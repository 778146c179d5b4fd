"""`python -m haselab`: the command line, for when the console script is not on the PATH."""

from haselab.cli.entry import main

__all__: list[str] = []

if __name__ == "__main__":
    main()
