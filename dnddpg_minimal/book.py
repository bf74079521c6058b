"""The chapters as files: run them, keep what they show, measure how long they take.

    python -m dnddpg_minimal book notebooks/05_second_critic.ipynb    run, and write
    python -m dnddpg_minimal book --measure                           only measure

To run a chapter here does what "Run all cells" and "Save" do in JupyterLab, but the
same numbers always write the same file: no times, no state of widgets, a progress bar
as it last looked (its speed differs), one output where a cell printed in pieces. And
pictures get a palette of 256 colours: a third as large. Then the chapter's last figure
goes to `notebooks/figures/`, if its top shows it.
"""

from __future__ import annotations

import base64
import io
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import tyro

from .benchmark import machine

ROOT = Path(__file__).parent.parent
CELL_LIMIT = 600  # seconds
WIDGET = "application/vnd.jupyter.widget-view+json"


def run_chapter(path):
    """Run the notebook at `path` in a kernel of its own → it, with its outputs.

    Nothing is written. Cells keep their times in `metadata.execution`. ValueError
    where a cell fails: the chapter, and what the cell said.
    """
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(Path(path).parent)}}
    try:
        NotebookClient(notebook, timeout=CELL_LIMIT, resources=place,
                       coalesce_streams=True).execute()  # a bar as it last looked
    except CellExecutionError as error:
        raise ValueError(f"{path}: a cell fails with {error.ename}: {error.evalue}. "
                         "The file is as it was.") from error
    return notebook


def tidy(notebook):
    """Take out of a notebook what differs from run to run, and shrink its pictures."""
    notebook.metadata.pop("widgets", None)
    notebook.metadata["language_info"] = {"name": "python"}
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            data.pop(WIDGET, None)  # a random name; the text stays
            if "image/png" in data:
                data["image/png"] = with_palette(data["image/png"])


def with_palette(png):
    """A PNG in base64 with the 256 colours that fit it best: a third as large.

    The eye sees no difference: figures have few colours, and rare ones are kept.
    """
    from PIL import Image

    image = Image.open(io.BytesIO(base64.b64decode(png)))
    if image.mode == "P":  # it has one
        return png
    smaller = io.BytesIO()
    white = Image.new("RGBA", image.size, "white")
    image = Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
    image = image.quantize(
        256, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    image.save(smaller, "PNG", optimize=True)
    return base64.b64encode(smaller.getvalue()).decode()


def write_chapter(notebook, path):
    """Write a notebook to `path` as JupyterLab does: keys in order, one space, newline.

    The file is written under another name, and takes its own name when complete.
    """
    import nbformat

    part = Path(f"{path}.part")
    nbformat.write(notebook, part)
    part.replace(path)


def pictures(notebook):
    """The PNGs of a notebook's outputs, in order, as bytes."""
    return [base64.b64decode("".join(output["data"]["image/png"]))
            for cell in notebook["cells"] for output in cell.get("outputs", [])
            if "image/png" in output.get("data", {})]


def save_last_figure(path):
    """Write the last figure of an executed notebook beside it, → the file's path.

    It becomes `figures/NN_name.png` in the notebook's folder. ValueError if the
    notebook shows no figure.
    """
    import nbformat

    path = Path(path)
    figures = pictures(nbformat.read(path, as_version=4))
    if not figures:
        raise ValueError(f"{path} holds no figure: run it first.")
    figure = path.parent / "figures" / f"{path.stem}.png"
    figure.parent.mkdir(exist_ok=True)
    figure.write_bytes(figures[-1])
    return figure


# --- Measuring ------------------------------------------------------------------------


def measured(path):
    """Run the chapter at `path` → (notebook, a dict: seconds, to first picture; kB).

    Seconds count from the start of its kernel. "largest PNG" is of its outputs.
    """
    started = time.time()
    notebook = run_chapter(path)
    row = {"chapter": Path(path).stem, "seconds": time.time() - started,
           "to first picture": float("nan")}  # a notebook may show none
    shown = (cell for cell in notebook.cells if pictures({"cells": [cell]}))
    first = next(shown, None)
    if first is not None:
        done = first.metadata.execution["shell.execute_reply"]
        done = datetime.fromisoformat(done.replace("Z", "+00:00")).timestamp()
        row["to first picture"] = done - started
    row["kB"] = Path(path).stat().st_size / 1e3
    row["largest PNG, kB"] = max(map(len, pictures(notebook)), default=0) / 1e3
    return notebook, row


def import_seconds(rounds=5):
    """Seconds to import this package, beyond Gymnasium's own, without torch.

    The median of `rounds` fresh processes.
    """
    code = ("import sys, time, gymnasium; start = time.perf_counter();"
            "import dnddpg_minimal; print(time.perf_counter() - start);"
            "assert 'torch' not in sys.modules")
    runs = [subprocess.run([sys.executable, "-c", code], check=True, text=True,
                           capture_output=True, cwd=ROOT) for _ in range(rounds)]
    return statistics.median(float(run.stdout) for run in runs)


def readme_commands():
    """README's second command in its parts: make the environment, install, test."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    command = re.search(r"^python3 -m venv .*pytest --nbval.*$", readme, re.M)[0]
    return [part.strip() for part in command.split("&&")]


def whole():
    """Seconds of README's second command in a fresh clone of what is committed.

    A dict: "install", "tests", and "browser", the browser's part of the tests.
    """
    make, install, test = readme_commands()
    seconds = {}
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["git", "clone", "-q", str(ROOT), folder], check=True)
        for name, parts in (("install", (make, install)),
                            ("tests", (f"{test} --junitxml=times.xml",))):
            started = time.time()
            for part in parts:
                subprocess.run(shlex.split(part), check=True, cwd=folder,
                               stdout=sys.stderr)
            seconds[name] = time.time() - started
        cases = ElementTree.parse(Path(folder) / "times.xml").iter("testcase")
        seconds["browser"] = sum(float(case.get("time")) for case in cases
                                 if "test_browser" in case.get("classname"))
    return seconds


# --- Command line ---------------------------------------------------------------------


def main(argv=None) -> int:
    """`python -m dnddpg_minimal book`: see --help. Returns the exit code."""
    return tyro.cli(command, args=argv, prog="python -m dnddpg_minimal book")


def command(chapters: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
            measure: bool = False, readme: bool = False) -> int:
    """Run chapters, write them, and say how long they took.

    Args:
        chapters: notebooks; none: every one in `notebooks/`.
        measure: write nothing.
        readme: time README's second command too, in a fresh clone. The last lines are
            then the table in README.
    """
    import pandas

    chapters = chapters or sorted((ROOT / "notebooks").glob("*.ipynb"))
    missing = [str(path) for path in chapters if not path.is_file()]
    if missing:
        raise FileNotFoundError(f"{missing[0]}: no such notebook.")
    rows = []
    for path in chapters:
        notebook, row = measured(path)
        rows.append(row)
        if not measure:
            tidy(notebook)
            write_chapter(notebook, path)
            row["kB"] = path.stat().st_size / 1e3
            if f"figures/{path.stem}.png" in notebook.cells[0].source:
                save_last_figure(path)
    rows = pandas.DataFrame(rows)
    print(machine())
    print(rows.to_string(index=False, float_format="%.1f", na_rep="-"))
    table = {"import, s": f"{import_seconds():.2f}",
             "a chapter, median, s": f"{rows.seconds.median():.0f}",
             "the longest": f"{rows.seconds.max():.0f}",
             "first picture, median": f"{rows['to first picture'].median():.0f}",
             "largest notebook, kB": f"{rows.kB.max():.0f}"}
    if readme:
        found = {name: f"{seconds / 60:.0f}" for name, seconds in whole().items()}
        table |= {"install, min": found["install"], "all tests, min": found["tests"],
                  "of these the browser's": found["browser"]}
    print()
    for line in (table, ["---"] * len(table), table.values()):
        print(f"| {' | '.join(line)} |")
    return 0
