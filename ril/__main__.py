"""`python -m ril` is `ril-run`."""

from ril.cli import as_command
from ril.cli.run import main

as_command("ril-run", main)
