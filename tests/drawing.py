"""Whether this machine can draw."""

import pytest

from vecpsmbpo.look import render

# What rendering needs of the machine; without it (a bare container) the tests of pictures have nothing to test.
try:
    render.platform()
    can_draw = True
except Exception:
    can_draw = False
draws = pytest.mark.skipif(not can_draw, reason="neither EGL nor OSMesa is installed")
