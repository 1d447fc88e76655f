from __future__ import annotations

import numpy as np
import pytest

from ril.report.figures.limits import limits

EPOCHS = np.arange(1, 37)


FIGURE = limits()


def line(panel: int, label: str) -> np.ndarray:
    [found] = [line for line in FIGURE.axes[panel].lines if line.get_label() == label]
    return np.asarray(found.get_xydata())


@pytest.mark.parametrize("k", [1, 1.5, 2, 2.5, 3, 3.5, 4])
def test_a_line_of_k_is_equation_2(k: float) -> None:
    expected = 1 - 1 / (1 + (150 / EPOCHS - 1) ** -k)
    np.testing.assert_allclose(line(0, f"k = {k:g}")[1:37, 1], expected)


@pytest.mark.parametrize("n", [37, 75, 112, 150])
def test_a_line_of_n_is_equation_2(n: int) -> None:
    expected = 1 - 1 / (1 + (n / EPOCHS - 1) ** -2.0)
    np.testing.assert_allclose(line(1, f"n = {n}")[1:37, 1], expected)


def test_lines_cover_150_epochs() -> None:
    np.testing.assert_array_equal(line(1, "n = 75")[:, 0], np.arange(151))


def test_a_line_of_n_is_labeled_at_its_right() -> None:
    for text in FIGURE.axes[1].texts:
        x, y = text.get_position()
        (epochs, limit) = line(1, text.get_text()).T
        assert 0 < x - np.interp(y, limit[: int(x) + 1], epochs[: int(x) + 1]) < 6
