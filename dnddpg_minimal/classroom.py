"""The classroom: what checks say, and exercises that are made from their solutions.

A check cell of an exercise calls

| call | passes if | else |
|---|---|---|
| `claim(ok, sentence)` | `ok` is true | AssertionError with the sentence |
| `close(value, expected, name)` | shape and numbers agree | ... with the numbers |

`close` returns the value as an array: a student may well return a list.

The one source of an exercise is `solutions/NN_name.ipynb`. From it

    python -m dnddpg_minimal.classroom generate      writes exercises/NN_name.ipynb
    python -m dnddpg_minimal.classroom course DIR    makes a course folder for nbgrader
    python -m dnddpg_minimal.classroom table         prints chapters, minutes, points

An exercise is made by nbgrader's own preprocessors and two of ours: `NumberedStubs` (a
stub names its exercise) and `RemoveSolutionCells` (cells with the tag `solution` go).
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
SOLUTION_TAG = "solution"  # a cell for the lecturer: analysis, tempting wrong answers
COURSE = '''"""What nbgrader needs to know about this course."""

from dnddpg_minimal.classroom import student_version

c = get_config()  # noqa: F821 (nbgrader defines it)
c.CourseDirectory.course_id = "dnddpg_minimal"
c.GenerateAssignment.preprocessors = student_version(save=True)
c.ExecutePreprocessor.timeout = 60  # seconds for one cell
'''


# --- What a check says ----------------------------------------------------------------


def claim(ok, sentence):
    """AssertionError with the sentence, unless `ok`. It should say what is wrong."""
    if not ok:
        raise AssertionError(sentence)


def close(value, expected, name, atol=1e-6, rtol=1e-6, mistakes=None):
    """AssertionError, in words and numbers, unless `value` is what was expected.

    value: what the student's code returned, which comes back as an array, also where it
    is a list; expected: an array or a number. `name` stands at the beginning of the
    sentence. Shapes must be equal, nothing is broadcast; a number may be off by atol
    + rtol · |expected|, so float32 is good enough.
    mistakes: {sentence: what one gets by this mistake}; the sentence is added where
    the value is that of the mistake.
    """
    expected = np.asarray(expected, float)
    if value is None:
        raise AssertionError(f"{name} is None. Does your function end in `return`?")
    try:
        value = np.asarray(value, float)
    except (TypeError, ValueError):
        raise AssertionError(f"{name} is a {type(value).__name__}: expected numbers of "
                             f"shape {expected.shape}.") from None

    def same(other):
        return value.shape == other.shape and np.allclose(value, other, rtol, atol)

    if same(expected):
        return value
    said = _difference(value, expected, name, rtol)
    for sentence, wrong in (mistakes or {}).items():
        if same(np.asarray(wrong, float)):
            raise AssertionError(f"{said} {sentence}")
    raise AssertionError(said)


def _difference(value, expected, name, rtol):
    """One sentence: the shapes, or the worst of the numbers, in digits that differ."""
    if value.shape != expected.shape:
        return f"{name} has shape {value.shape}: expected {expected.shape}."
    if not np.isfinite(value).all():
        return f"{name} holds {value[~np.isfinite(value)][0]}: expected finite numbers."
    gap = np.abs(value - expected)
    gap = np.where(gap > rtol * np.abs(expected), gap, 0)  # what is near is not worst
    worst = np.unravel_index(gap.argmax(), value.shape)
    found, wanted = value[worst], expected[worst]
    digits = next((digits for digits in range(6, 17)
                   if f"{found:.{digits}g}" != f"{wanted:.{digits}g}"), 17)
    place = f" at [{', '.join(map(str, worst))}]" if worst else ""
    return (f"{name} {'has' if place else 'is'} {found:.{digits}g}{place}: expected "
            f"{wanted:.{digits}g}.")


# --- Exercises from solutions ---------------------------------------------------------


def number_of(grade_id):
    """A cell's grade_id → its exercise's number, or None for any other name.

    "exercise-1-2", "check-1-2b", "given-1-2" → "1.2".
    """
    found = re.fullmatch(r"(?:exercise|check|given)-(\d+)-(\d+)[a-z]?", str(grade_id))
    return f"{int(found[1])}.{found[2]}" if found else None


def student_version(save=False):
    """nbgrader's preprocessors that make an exercise of a solution, in their order.

    With `save` the cells also go into the course's gradebook. Imports nbgrader.
    """
    from nbgrader import preprocessors as nbgrader

    class RemoveSolutionCells(nbgrader.NbGraderPreprocessor):
        """Analysis and tempting wrong answers are not for students."""

        def preprocess(self, nb, resources):
            nb.cells = [cell for cell in nb.cells
                        if SOLUTION_TAG not in cell.metadata.get("tags", [])]
            return nb, resources

    class NumberedStubs(nbgrader.ClearSolutions):
        """A stub names its exercise: `raise NotImplementedError("Exercise 1.1: ...")`.
        """

        def preprocess_cell(self, cell, resources, index):
            number = number_of(cell.metadata.get("nbgrader", {}).get("grade_id"))
            words = f"Exercise {number}: not done yet"
            stub = f'# YOUR CODE HERE\nraise NotImplementedError("{words}")'
            self.code_stub = {"python": stub}
            return super().preprocess_cell(cell, resources, index)

    return [
        RemoveSolutionCells,
        nbgrader.LockCells,
        NumberedStubs,
        nbgrader.ClearOutput,
        nbgrader.CheckCellMetadata,
        nbgrader.ComputeChecksums,
        *([nbgrader.SaveCells] if save else []),
        nbgrader.ClearHiddenTests,
        nbgrader.ClearMarkScheme,
        nbgrader.ComputeChecksums,
        nbgrader.CheckCellMetadata,
    ]


def exercise_of(solution):
    """The text of the exercise (.ipynb) that a solution, a path, becomes."""
    from nbconvert.exporters import NotebookExporter

    exporter = NotebookExporter()
    for preprocessor in student_version():
        exporter.register_preprocessor(preprocessor)
    text, _ = exporter.from_filename(str(solution))
    return text.rstrip("\n") + "\n"


def generate(solutions=ROOT / "solutions", exercises=ROOT / "exercises"):
    """Write the exercise of every solution; yield their paths."""
    exercises.mkdir(exist_ok=True)
    for solution in sorted(solutions.glob("*.ipynb")):
        path = exercises / solution.name
        path.write_text(exercise_of(solution), encoding="utf-8", newline="\n")
        yield path


def course(folder, solutions=ROOT / "solutions"):
    """Make a course folder: nbgrader's configuration, and an assignment a chapter.

    `solutions` is the folder that they come from. Raises FileExistsError if `folder`
    holds a course already.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "nbgrader_config.py", "x", encoding="utf-8") as file:
        file.write(COURSE)
    for solution in sorted(solutions.glob("*.ipynb")):
        assignment = folder / "source" / solution.stem
        assignment.mkdir(parents=True)
        shutil.copy(solution, assignment)


def table(solutions=ROOT / "solutions"):
    """A line of a Markdown table for every solution, with its minutes and points."""
    head = re.compile(r"^## Exercise .*\n\n.* · (\d+) minutes · (\d+) points", re.M)
    for solution in sorted(solutions.glob("*.ipynb")):
        cells = json.loads(solution.read_text(encoding="utf-8"))["cells"]
        found = head.findall("\n".join("".join(cell["source"]) for cell in cells))
        minutes, points = (sum(map(int, column)) for column in zip(*found))
        name = solution.stem
        yield (f"| [{name}](../exercises/{name}.ipynb) | [solution]({name}.ipynb) "
               f"| {len(found)} | {minutes} | {points} |")


def main(argv=None) -> int:
    """`generate`, `course DIR` or `table`, as above. Returns the exit code."""
    match sys.argv[1:] if argv is None else argv:
        case ["generate"]:
            for path in generate():
                print(path.relative_to(ROOT))
        case ["course", folder]:
            try:
                course(Path(folder))
            except OSError as error:
                print(f"{error.filename}: {error.strerror}", file=sys.stderr)
                return 2
            print(f"A course of {len(list(Path(folder, 'source').iterdir()))} "
                  f"assignments in {folder}. Next: solutions/README.md")
        case ["table"]:
            print(*table(), sep="\n")
        case _:
            print("python -m dnddpg_minimal.classroom generate | course DIR | table",
                  file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
