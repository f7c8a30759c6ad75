"""``python -m warp_ir`` is the command `warp-ir`."""

from warp_ir.cli import command

command()
