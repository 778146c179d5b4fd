"""`python -m haselab.app`."""

from haselab.app.entry import main

main()
