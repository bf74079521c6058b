"""`python -m dnddpg_minimal check my/NN_name.ipynb`: points, and what is wrong.

Several notebooks may be named, and `--csv FILE` collects their points in a table. Each
notebook runs from top to bottom in a fresh kernel. Whoever changed a check does
not fool it: checks and given code are taken from `solutions/` where that folder is,
hidden tests included. Without it the notebook's own are taken, and a check that was
changed earns nothing. (It is no fortress: who rewrites the package itself can pass.)
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

import tyro

from dnddpg_minimal.classroom import ROOT, number_of

NOT_RUN = "was not run: the time for the whole notebook was over"


def main(argv=None) -> int:
    """`python -m dnddpg_minimal check`: see --help. Returns the exit code."""
    return tyro.cli(command, args=argv, prog="python -m dnddpg_minimal check")


def command(notebooks: Annotated[tuple[Path, ...], tyro.conf.Positional],
            seconds: int = 60, total: int = 300, csv: Path | None = None) -> int:
    """Run exercise notebooks afresh; print their points, and what is wrong.

    A time limit below 1 is refused, and a file that is no exercise. Of several files
    such a one is named and left out.

    Args:
        notebooks: what to check, one or more files; they are not changed.
        seconds: time limit of one cell. A cell that takes longer is left out.
        total: time limit of a whole notebook.
        csv: also write a table to this file: a row per notebook and exercise.
    """
    import pandas as pd

    if min(seconds, total) < 1:
        raise ValueError(f"--seconds {seconds} --total {total}: expected 1 or more")
    if not notebooks:
        raise ValueError("no notebook named: expected one file or more")
    if csv is not None and not csv.parent.is_dir():
        raise ValueError(f"--csv {csv}: there is no folder {csv.parent}")
    rows, code = [], 0
    for notebook in notebooks:
        try:
            found = check(notebook, seconds, total)
        except (OSError, ValueError) as error:
            if len(notebooks) == 1:
                raise
            print(f"{notebook}: left out. {error}\n")
            code = 2
            continue
        code = max(code, int(any(one["points"] < one["possible"] for one in found)))
        rows += [{"notebook": str(notebook)} | one for one in found]
        if csv is not None:  # after each: nothing is lost if a later one goes wrong
            pd.DataFrame(rows).to_csv(csv, index=False)
        if len(notebooks) > 1:
            print()
    return code


def check(notebook, seconds, total):
    """Run one notebook, print what was found; a dict for each exercise.

    The time limits are `command`'s. OSError or ValueError if it is no exercise.
    """
    nb = read(notebook)
    source, where = source_of(nb, notebook)
    cells, changed = with_checks_of(source, nb)
    errors = run(cells, notebook.resolve().parent, seconds, total)
    print(f"{notebook}: {where}")
    results = exercises(cells, errors, changed)
    for number, (points, possible, sentences) in results.items():
        print(f"Exercise {number}: {points:g} of {possible:g} points")
        for sentence in dict.fromkeys(sentences):
            print(f"    {sentence}")
    points = sum(points for points, _, _ in results.values())
    possible = sum(possible for _, possible, _ in results.values())
    print(f"Together: {points:g} of {possible:g} points")
    return [{"exercise": number, "points": points, "possible": possible,
             "said": " ".join(dict.fromkeys(sentences))}
            for number, (points, possible, sentences) in results.items()]


# --- Which cells ----------------------------------------------------------------------


def read(path):
    """The notebook at path. OSError if there is none, ValueError if it is broken."""
    import nbformat

    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no notebook, or damaged: {error}") from error
    if not (isinstance(content, dict) and isinstance(content.get("cells"), list)):
        raise ValueError(f"{path} is no notebook: it holds no list of cells")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # old files: cells without an id
            nb = nbformat.reads(json.dumps(content), as_version=4)
            nbformat.validate(nb)
    except Exception as error:  # nbformat raises whatever it meets
        words = str(error).split("\n")[0]
        raise ValueError(f"{path} is a damaged notebook: {words}") from error
    return nb


def id_of(cell):
    """The grade_id of a cell of an exercise, or None."""
    about = cell.metadata.get("nbgrader")
    grade_id = about.get("grade_id") if isinstance(about, dict) else None
    return grade_id if number_of(grade_id) else None


def is_locked(cell):
    """Is this cell a check or given code? Students do not write there."""
    return id_of(cell) is not None and not cell.metadata.nbgrader.get("solution")


def is_check(cell):
    """Is this cell a check, a locked one that gives points?"""
    return is_locked(cell) and bool(cell.metadata.nbgrader.get("grade"))


def source_of(nb, path):
    """The notebook that the checks come from, and a phrase about it.

    path: where `nb` lies; its name tells the chapter where no cell does. Raises
    ValueError if there is no exercise in `nb`.
    """
    numbers = [number_of(id_of(cell)) for cell in nb.cells if id_of(cell)]
    chapter = int(numbers[0].split(".")[0]) if numbers else None
    if chapter is None and path.name[:2].isdecimal():
        chapter = int(path.name[:2])
    for solution in (ROOT / "solutions").glob(f"{chapter or 0:02d}_*.ipynb"):
        chapter_itself = path.resolve().parent.name == "notebooks"  # of the same name
        stripped = path.name == solution.name and not chapter_itself
        if numbers or stripped:  # by a program that keeps no metadata
            return read(solution), (f"checks of solutions/{solution.name}, "
                                    "hidden tests included")
    checks = [cell for cell in nb.cells if is_check(cell)]
    for cell in checks:
        points = cell.metadata.nbgrader.get("points")
        if not (type(points) in (int, float) and 0 <= points <= 1_000):  # no NaN, too
            raise ValueError(f"{path} is damaged: {id_of(cell)} has points={points!r}")
    if not checks:
        raise ValueError(f"{path} holds no exercise with a check")
    return nb, "its own checks (there is no solution of it here)"


def with_checks_of(source, nb):
    """The code cells to run: those of `nb`, with checks and given code of `source`.

    Returns them and the ids of checks that are the student's own and were changed.
    """
    originals = {id_of(cell): cell for cell in source.cells if is_locked(cell)}
    cells, seen = [], set()
    for cell in nb.cells:
        name = id_of(cell)
        if is_locked(cell):
            if name in seen or name not in originals:
                continue  # a copy, or a check that the student made up
            cell = originals[name]
        if cell.cell_type == "code":
            cells.append(cell)
            seen.add(name)
    seen.discard(None)  # cells of the student's own
    at = 0 if seen else len(cells)
    for original in source.cells:  # what was deleted comes back in its place
        name = id_of(original)
        if name in seen:
            at = [id_of(cell) for cell in cells].index(name) + 1
        elif name in originals:
            cells.insert(at, original)
            at += 1
    own = originals.values() if source is nb else ()
    return cells, {id_of(cell) for cell in own if is_check(cell) and was_changed(cell)}


def was_changed(cell):
    """True if the cell is not what nbgrader's checksum says that it was."""
    from nbgrader.utils import compute_checksum

    return cell.metadata.nbgrader.get("checksum") != compute_checksum(cell)


# --- Running --------------------------------------------------------------------------


def run(cells, folder, seconds, total):
    """Run code cells in a fresh kernel → {index: (kind of error, its text)}.

    folder: where the kernel works. A cell may take so many `seconds`, all of them
    together `total`. A cell that takes too long, or ends the kernel, is left out and
    the rest is run again without it, as long as there is time. What a cell did before
    is known, and counts where there is no time to run it again.
    """
    from nbclient.exceptions import CellTimeoutError, DeadKernelError

    end, left_out = time.monotonic() + total, {}
    known = {}  # index: its error when it ran last, None for none
    while True:
        errors = dict(left_out)
        client = fresh_client(cells, folder)
        with client.setup_kernel(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL):
            for index, cell in enumerate(cells):
                if index in left_out:
                    continue
                left = int(end - time.monotonic())  # nbclient wants whole seconds
                client.timeout = min(seconds, left)
                try:
                    if left < 1:
                        raise CellTimeoutError
                    client.execute_cell(cell, index)
                except CellTimeoutError:
                    if left < 1 or index in known:  # the time is over for all cells
                        end = time.monotonic()
                        if error := known.get(index, ("", NOT_RUN)):
                            errors[index] = error
                        continue
                    left_out[index] = "", f"ran longer than {client.timeout} s"
                    break
                except DeadKernelError:
                    left_out[index] = "", "ended the kernel"
                    break
                known[index] = None
                for output in cell.outputs:
                    if output.output_type == "error":
                        known[index] = errors[index] = output.ename, output.evalue
            else:
                return errors


def fresh_client(cells, folder):
    """An nbclient for these cells, at work in a folder, whose kernel is this Python."""
    from ipykernel.kernelspec import get_kernel_dict
    from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
    from nbclient import NotebookClient
    from nbformat.v4 import new_notebook

    class ThisPython(KernelSpecManager):
        def get_kernel_spec(self, kernel_name):
            return KernelSpec(**get_kernel_dict())

    client = NotebookClient(
        new_notebook(cells=cells), kernel_name="python3", allow_errors=True,
        resources={"metadata": {"path": str(folder)}}, shutdown_kernel="immediate")
    client.create_kernel_manager().kernel_spec_manager = ThisPython()
    return client


# --- Points ---------------------------------------------------------------------------


def exercises(cells, errors, changed=()):
    """{number: (points, possible points, sentences about what is wrong)}.

    errors: as `run` returns them for these cells; changed: ids of checks that are not
    what they were, and give no points.
    """
    results = {}
    for index, cell in enumerate(cells):
        if not is_check(cell):
            continue
        number = number_of(id_of(cell))
        points, possible, sentences = results.get(number, (0, 0, []))
        worth = cell.metadata.nbgrader.get("points", 0)
        if id_of(cell) in changed:
            sentences = [*sentences, "its check was changed: take the notebook afresh"]
        elif index not in errors:
            points += worth
        else:
            sentences = [*sentences, *stopped(cells, errors, number, index)]
        results[number] = points, possible + worth, sentences
    return results


def stopped(cells, errors, number, index):
    """Why a check did not pass: errors in the exercise's other cells, then its own.

    The check is cells[index], of the exercise with this number; errors as in `run`.
    """
    for other in range(index):
        if other in errors and number_of(id_of(cells[other])) == number \
                and not is_check(cells[other]):
            yield f"the cell above its check: {in_words(*errors[other])}"
    yield in_words(*errors[index])


def in_words(name, text):
    """An error, its name and its text, as one line. An AssertionError is a sentence."""
    text = " ".join(text.split())
    if name == "NotImplementedError":
        return "not done yet: a raise NotImplementedError is left"
    if name not in ("", "AssertionError"):
        text = f"{name}: {text}"
    if "NoneType" in text:
        text = f"{text.rstrip('.')}. Does your function end in `return`?"
    return text


if __name__ == "__main__":
    sys.exit(main())
