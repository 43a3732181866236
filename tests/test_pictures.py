"""The pictures in docs/ are those that `make pictures` draws."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("nilearn")
from PIL import Image

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "scripts"))

import draw_docs  # noqa: E402

TILES = 60, 25  # across and down a picture
DIFFERENCE = 0.005  # of colours from 0 to 1, in the mean
QUICK = ["cortex", "first_laplacian", "surface", "wavelets"]  # and of no signs of modes


def difference(one, other):
    """Of the mean colours of two pictures in the tiles, in the mean."""
    tiles = [
        np.asarray(Image.open(path).convert("RGB").resize(TILES, Image.Resampling.BOX), float)
        for path in (one, other)
    ]
    return np.abs(tiles[0] - tiles[1]).mean() / 255


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", QUICK)
def test_a_picture_is_what_its_script_draws(name, tmp_path):
    drawn = draw_docs.draw(name, tmp_path)
    assert difference(drawn, draw_docs.PICTURES[name]) < DIFFERENCE


def test_another_picture_is_not(tmp_path):
    """Nor the same one with a panel in the place of another."""
    path = draw_docs.PICTURES["wavelets"]
    picture = Image.open(path).convert("RGB")
    panel = [side // n for side, n in zip(picture.size, (3, 2), strict=True)]
    picture.paste(picture.crop((0, 0, *panel)), (panel[0], 0))
    picture.save(tmp_path / "changed.png")
    assert difference(tmp_path / "changed.png", path) > 2 * DIFFERENCE
    assert difference(draw_docs.PICTURES["cortex"], path) > 2 * DIFFERENCE


def test_every_picture_is_drawn_by_a_script():
    """Or is named as one that is not."""
    examples = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert {*draw_docs.PICTURES} <= examples | {"cortex", "surface"}
    assert all((ROOT / "docs").rglob(f"{name}.png") for name in draw_docs.NOT_DRAWN)
