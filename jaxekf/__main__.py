"""`python -m jaxekf`."""

from jaxekf.cli import main

main(prog_name="jaxekf")
