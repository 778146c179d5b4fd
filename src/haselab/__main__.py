"""`python -m haselab`: the command line, where the console script is not on the path."""

from haselab.cli.entry import main

__all__: list[str] = []

if __name__ == "__main__":
    main()
