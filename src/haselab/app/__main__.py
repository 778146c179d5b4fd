"""`python -m haselab.app`."""

from haselab.app.main import main

main()
