"""Rollouts drawn over the truth, with particles that have no edge."""

from __future__ import annotations

import numpy as np
import pytest

from mbds_xsim.studies.shift import present as shift_motion


@pytest.mark.parametrize(("line", "face"), [("-", "C0"), ("--", "none")])
def test_a_particle_without_edges_is_a_dot(line: str, face: str) -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    look = {"color": "C0", "ls": line, "lw": 1.0, "alpha": 1.0}
    nodes = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [2.0, 0.0, 3.0]])
    shift_motion._draw_nodes(axes, np.array([[0, 1]]), nodes, look)
    edge, dots = axes.lines
    assert np.array_equal(edge.get_xydata(), [[0.0, 0.0], [1.0, 1.0]])
    assert np.array_equal(dots.get_xydata(), [[2.0, 3.0]])
    assert dots.get_marker() == "o"
    assert dots.get_markerfacecolor() == face
