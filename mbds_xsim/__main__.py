"""`python -m mbds_xsim` is `mbds-xsim`."""

from mbds_xsim.cli import main

main()
