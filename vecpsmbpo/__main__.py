"""The program, as `vecpsmbpo` or `python -m vecpsmbpo`. Ctrl-C is taken care of before anything else is imported."""

import sys

from vecpsmbpo import interrupt


def main() -> int:
    """The exit status."""
    with interrupt.leaving():
        from vecpsmbpo import cli
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
