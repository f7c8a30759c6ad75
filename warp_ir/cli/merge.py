"""`warp-ir merge`: makes the picture of films that `warp-ir render --part` has written."""

import argparse

from warp_ir.cli import render
from warp_ir.cli.arguments import parse
from warp_ir.cli.parts import read_part, render_words, sorted_parts
from warp_ir.files import check_input
from warp_ir.image.ocio import use_config
from warp_ir.scene import InputError


def run(args: argparse.Namespace) -> int:
    """Checks that the films make up one picture, loads their stage, and writes the picture; returns the exit code."""
    films = sorted_parts([read_part(path) for path in args.films])
    first = films[0]
    stage = args.stage or first.stage
    check_input(stage, "a USD file")
    # The flags of the films are checked as those of a command line are; what merge is given wins.
    try:
        whole = parse(["render", stage, args.output, *render_words(first)])
    except InputError as error:
        raise InputError(f"{first.path}: {error}") from None
    for name, value in vars(args).items():
        if name not in ("command", "stage", "films", "settings"):
            setattr(whole, name, value)
    whole.checkpoint = 0.0
    with use_config(whole.ocio_config):
        return render.run(whole, films)
