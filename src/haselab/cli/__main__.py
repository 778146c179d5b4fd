"""`python -m haselab.cli`."""

from haselab.cli.entry import main

main()
