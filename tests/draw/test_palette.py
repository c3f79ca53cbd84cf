"""The colors of parts and values."""

from __future__ import annotations

import numpy as np

from dpcli.draw.palette import DARK, LIGHT, PALETTE, UNKNOWN, heat_colors, part_colors


def test_colors_are_apart_also_for_the_color_blind() -> None:
    """The first eight in the LMS space of Vienot et al. 1999: no two the same without red or without green cones."""
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    protan, deutan = np.eye(3), np.eye(3)
    protan[0], deutan[1] = [0, 2.02344, -2.52581], [0.494207, 0, 1.24827]
    linear = (PALETTE[:8] / 255) ** 2.2
    for sight in (np.eye(3), protan, deutan):
        seen = np.clip(linear @ (np.linalg.inv(to_lms) @ sight @ to_lms).T, 0, 1) ** (1 / 2.2)
        apart = np.linalg.norm(seen[:, None] - seen, axis=-1) + 9 * np.eye(8)
        assert apart.min() > 0.1
    assert len(np.unique(PALETTE, axis=0)) == len(PALETTE)


def test_part_colors() -> None:
    colors = part_colors(np.array([0, 3, -1, len(PALETTE)], np.int16))
    np.testing.assert_array_equal(colors, [PALETTE[0], PALETTE[3], UNKNOWN, PALETTE[0]])
    assert tuple(PALETTE[0]) == (0, 114, 178)


def test_heat_goes_from_blue_to_red_and_is_clamped() -> None:
    low, high = heat_colors(np.array([0.0, 1.0])).astype(int)
    assert low[2] > low[0] + 50 and high[0] > high[2] + 100
    np.testing.assert_array_equal(heat_colors(np.array([-3.0, 9.0])), [low, high])
    np.testing.assert_array_equal(heat_colors(np.array([0.0, 1.0]), 0.94, 0.06), [high, low])


def test_cells_stand_out_on_a_dark_page_alone() -> None:
    assert DARK.page == (27, 30, 36) and LIGHT.page == LIGHT.background
