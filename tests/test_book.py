"""The chapters as files: they are as `book` writes them; measuring changes nothing."""

import base64
import io
import re
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from PIL import Image

from dnddpg_minimal import book
from dnddpg_minimal.__main__ import main

pytestmark = pytest.mark.slow

CHAPTERS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
by_name = pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.stem)


@by_name
def test_a_chapter_is_stored_as_book_writes_it(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    book.tidy(notebook)
    book.write_chapter(notebook, tmp_path / "x.ipynb")
    assert (tmp_path / "x.ipynb").read_bytes() == path.read_bytes()


@by_name
def test_the_picture_at_the_top_is_the_chapters_last_figure(path):
    notebook = nbformat.read(path, as_version=4)
    top = re.findall(r"!\[.+?\]\((figures/\S+\.png)\)", notebook.cells[0].source)
    if not top:
        pytest.skip("no picture at its top")
    shown = path.parent / top[0]  # 00 shows another chapter's
    whose = nbformat.read(path.parent / f"{shown.stem}.ipynb", as_version=4)
    assert shown.read_bytes() == book.pictures(whose)[-1]


@by_name
def test_a_stored_picture_has_a_palette(path):
    notebook = nbformat.read(path, as_version=4)
    for png in book.pictures(notebook):
        assert Image.open(io.BytesIO(png)).mode == "P"


@by_name
def test_what_a_cell_prints_fits_the_page(path):
    """JupyterLab breaks longer lines anywhere, within words and numbers too."""
    for cell in nbformat.read(path, as_version=4).cells:
        for output in cell.get("outputs", []):
            long = [line for line in output.get("text", "").splitlines()
                    if len(line) > 100]
            assert not long, f"{cell.id}: {long[0]}"


def test_a_palette_makes_a_figure_smaller_and_changes_no_colour_that_one_sees():
    _, ax = plt.subplots(figsize=(7, 3))
    x = np.linspace(0, 6, 200)
    for shift in range(8):
        ax.plot(x, np.sin(x + shift))
    ax.imshow(np.add.outer(x, x), extent=(0, 6, -1, 1), cmap="cividis", aspect="auto")
    whole = io.BytesIO()
    plt.savefig(whole, dpi=100)
    plt.close()
    png = base64.b64encode(whole.getvalue()).decode()
    smaller = book.with_palette(png)
    assert len(smaller) < 0.6 * len(png)
    one, other = (np.asarray(Image.open(io.BytesIO(base64.b64decode(p))).convert("RGB"),
                             float) for p in (png, smaller))
    assert one.shape == other.shape and np.abs(one - other).mean() < 2  # of 255
    assert np.abs(one - other).max() < 25
    assert book.with_palette(smaller) == smaller


def small_chapter(folder, *cells):
    """A notebook of these cells, written to `folder`; its path."""
    (folder / "figures").mkdir()
    path = folder / "13_small.ipynb"
    notebook = new_notebook(cells=[*cells], metadata={"kernelspec": {
        "name": "python3", "display_name": "Python 3", "language": "python"}})
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    nbformat.write(notebook, path)
    return path


FIGURE = """import matplotlib.pyplot as plt
print(1, end="\\r"); print(2)
plt.plot([0, 1])
plt.show()
print(3)"""


def test_a_chapter_that_runs_is_written_whole_and_the_same_twice(tmp_path, capsys):
    path = small_chapter(tmp_path, new_markdown_cell("![x](figures/13_small.png)"),
                         new_code_cell(FIGURE))
    assert main(["book", str(path)]) == 0
    once = path.read_bytes()
    figure = tmp_path / "figures" / "13_small.png"
    assert figure.read_bytes().startswith(b"\x89PNG")
    outputs = nbformat.read(path, as_version=4).cells[1].outputs
    assert [output.get("text") for output in outputs] == ["2\n3\n", None]
    assert main(["book", str(path)]) == 0
    assert path.read_bytes() == once
    capsys.readouterr()
    assert main(["book", "--measure", str(path)]) == 0  # writes nothing
    assert path.read_bytes() == once
    table = capsys.readouterr().out
    assert "13_small" in table and "longest" in table


def test_a_chapter_that_fails_is_left_as_it_was(tmp_path, capsys):
    path = small_chapter(tmp_path, new_code_cell("1 / 0"))
    before = path.read_bytes()
    assert main(["book", str(path)]) == 2
    error = capsys.readouterr().err
    assert "13_small" in error and "ZeroDivisionError" in error
    assert path.read_bytes() == before


def test_a_notebook_that_is_not_there_is_named(capsys):
    assert main(["book", "notebooks/99_no.ipynb"]) == 2
    assert "99_no.ipynb" in capsys.readouterr().err


def test_a_notebook_that_was_never_run_has_no_last_figure(tmp_path):
    path = small_chapter(tmp_path, new_code_cell("1"))
    with pytest.raises(ValueError, match="run it first"):
        book.save_last_figure(path)


def test_what_is_timed_is_the_command_of_the_readme():
    make, install, test = book.readme_commands()
    assert "venv" in make and "requirements.txt" in install
    assert test.endswith("pytest --nbval")
