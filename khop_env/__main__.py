"""`python -m khop_env` is `khop`."""

from khop_env.cli import main

main()
