"""Exercises and their solutions: each solution passes, and nothing else does.

Cells run here with `exec` in this process, which for these notebooks is the same as a
kernel and much faster; the kernels themselves are the business of nbval (solutions)
and of `test_check.py`.
"""

import contextlib
import io
import json
import re
from functools import cache, partial
from pathlib import Path
from types import FunctionType

import matplotlib
import numpy as np
import pytest

from dnddpg_minimal import classroom
from dnddpg_minimal.check import id_of, is_check, read

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SOLUTIONS = sorted((ROOT / "solutions").glob("*.ipynb"))
MARKERS = {name: re.compile(f"^ *### BEGIN {name}\n(.*?)^ *### END {name}$",
                            re.M | re.S) for name in ("SOLUTION", "HIDDEN TESTS")}

each_solution = pytest.mark.parametrize("solution", SOLUTIONS, ids=lambda p: p.stem)


@cache
def exercise_of(solution):
    """The exercise as text, generated afresh."""
    return classroom.exercise_of(solution)


class Kernel:
    """Cells in one namespace, and nothing on the screen."""

    def __init__(self):
        self.names = {"__name__": "__main__"}

    def run(self, source):
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(source, "<cell>", "exec"), self.names)

    @contextlib.contextmanager
    def undone(self):
        """What happens to the names inside is undone afterwards."""
        before = dict(self.names)
        yield
        self.names.clear()
        self.names.update(before)


@pytest.fixture(autouse=True)
def _figures_are_drawn_nowhere(monkeypatch):
    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))


def is_wrong_answer(cell):
    return "wrong-answer" in cell.metadata.get("tags", [])


def parts(solution):
    """One list of cells for each exercise, without what stands before the first."""
    found = []
    for cell in read(solution).cells:
        if cell.cell_type == "markdown" and cell.source.startswith("## Exercise "):
            found.append([])
        if found:
            found[-1].append(cell)
    return found


# --- How they are made ----------------------------------------------------------------


def test_every_chapter_up_to_eleven_has_its_exercises():
    chapters = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
                if 1 <= int(path.stem[:2]) <= 11]
    assert [path.stem for path in SOLUTIONS] == chapters


@each_solution
def test_the_exercise_is_what_its_solution_generates(solution):
    stored = (ROOT / "exercises" / solution.name).read_text(encoding="utf-8")
    assert stored == exercise_of(solution), (
        "run: python -m dnddpg_minimal.classroom generate")


def test_there_is_no_exercise_without_a_solution():
    exercises = sorted(path.name for path in (ROOT / "exercises").glob("*.ipynb"))
    assert exercises == [path.name for path in SOLUTIONS]


@each_solution
def test_an_exercise_has_stars_minutes_why_hints_a_check_and_a_stretch(solution):
    chapter, numbers, kinds = int(solution.stem[:2]), [], set()
    for cells in parts(solution):
        problem = cells[0].source
        number, stars, points, kind = re.match(
            r"## Exercise (\d+\.\d+) · .+\n\n([★☆]{3}) · \d+ minutes · "
            r"(\d+) points · \*(.+)\*\n", problem).groups()
        numbers.append(number)
        kinds.add(kind)
        assert "**Why it matters.**" in problem
        text = "\n".join(cell.source for cell in cells)
        assert text.count("<details>") == 2 and "**Stretch.**" in text
        assert f"### Analysis of {number}" in text
        assert sum(map(is_wrong_answer, cells)) >= 2
        checks = [cell for cell in cells if is_check(cell)]
        assert all(classroom.number_of(id_of(cell)) == number for cell in checks)
        assert sum(cell.metadata.nbgrader.points for cell in checks) == int(points)
        assert int(points) == 2 * stars.count("★")
    assert numbers == [f"{chapter}.{n}" for n in range(1, len(numbers) + 1)]
    assert len(numbers) >= 2
    assert kinds <= {"derive and code", "find the silent bug", "predict, then measure"}


def test_the_lecturers_table_says_the_minutes_and_points_of_each_chapter():
    guide = (ROOT / "solutions" / "README.md").read_text(encoding="utf-8")
    for line in classroom.table():
        assert line in guide.splitlines(), (
            "print the lines: python -m dnddpg_minimal.classroom table")
    assert guide.count("[solution](") == len(SOLUTIONS)


def test_a_course_is_made_once_and_other_words_are_refused(tmp_path, capsys):
    assert classroom.main(["course", str(tmp_path / "course")]) == 0
    made = {path.parent.name for path in (tmp_path / "course").rglob("*.ipynb")}
    assert made == {path.stem for path in SOLUTIONS}
    assert classroom.main(["course", str(tmp_path / "course")]) == 2
    assert "exists" in capsys.readouterr().err
    assert classroom.main(["generat"]) == 2


# --- What passes, and what does not ---------------------------------------------------


@each_solution
def test_the_solution_passes_and_every_tempting_wrong_answer_fails(solution):
    kernel, cells = Kernel(), read(solution).cells
    for index, cell in enumerate(cells):
        if cell.cell_type != "code":
            continue
        if cell.metadata.get("nbgrader", {}).get("solution"):
            rest = cells[index + 1:]
            length = next((i for i, other in enumerate(rest)
                           if other.source.startswith("## ")), len(rest))
            for wrong in filter(is_wrong_answer, rest[:length]):
                with kernel.undone():
                    assert_fails(kernel, wrong.source, rest[:length])
        kernel.run(cell.source)


def has_arrays(value):
    """Is this an array, or a tuple with one? Numbers are none."""
    return any(isinstance(one, np.ndarray) and one.ndim
               for one in (value if isinstance(value, tuple) else (value,)))


def as_lists(value):
    """The same with lists for arrays, also within a tuple."""
    if isinstance(value, tuple):
        return tuple(map(as_lists, value))
    return value.tolist() if has_arrays(value) else value


def remember_arrays(name, names, value):
    """The value, unchanged; the name joins `names` if there is an array in it."""
    if has_arrays(value):
        names.add(name)
    return value


def wrapped(function, change):
    """A function whose results go through `change`."""
    def call(*args, **kwargs):
        return change(function(*args, **kwargs))

    call.__name__ = function.__name__
    return call


ARRAYS_ONLY = {"save"}  # exercise 9.3 asks for a float64 array


@each_solution
def test_a_solution_may_return_lists_in_place_of_arrays(solution):
    kernel, cells = Kernel(), read(solution).cells
    for index, cell in enumerate(cells):
        if cell.cell_type != "code":
            continue
        before = dict(kernel.names)
        kernel.run(cell.source)
        if not cell.metadata.get("nbgrader", {}).get("solution"):
            continue
        rest = cells[index + 1:]
        check = next(other for other in rest if is_check(other))
        functions = {name: value for name, value in kernel.names.items()
                     if isinstance(value, FunctionType) and before.get(name) != value}
        of_arrays = set()
        with kernel.undone():
            for name, function in functions.items():
                kernel.names[name] = wrapped(
                    function, partial(remember_arrays, name, of_arrays))
            kernel.run(check.source)
        for name in of_arrays - ARRAYS_ONLY:
            with kernel.undone():
                kernel.names[name] = wrapped(functions[name], as_lists)
                kernel.run(check.source)


def assert_fails(kernel, wrong, cells):
    """The checks among `cells` say to the wrong answer what is printed beside it."""
    code = re.search(r"^```python\n(.*?)^```$", wrong, re.M | re.S)[1]
    printed = wrong.split("\n> The check says: ")[1]
    kernel.run(code)
    said = None
    for cell in cells:
        if cell.cell_type == "code" and said is None:
            try:
                kernel.run(cell.source)
            except AssertionError as error:
                said = str(error)
    assert said is not None, f"this passes:\n{code}"
    digits = r"[-−+]?\d[\d.]*(?:e[-+]\d+)?"
    assert re.sub(digits, "#", said) == re.sub(digits, "#", printed)
    numbers = [[float(number.replace("−", "-").rstrip("."))
                for number in re.findall(digits, text)] for text in (said, printed)]
    np.testing.assert_allclose(*numbers, rtol=0.02, atol=1e-3)


@each_solution
def test_every_stub_fails_by_its_own_number_and_the_other_cells_run(solution):
    kernel, nb = Kernel(), json.loads(exercise_of(solution))
    failed = []
    for cell in nb["cells"]:
        if cell["cell_type"] != "code":
            continue
        grade_id = cell["metadata"].get("nbgrader", {}).get("grade_id", "")
        if grade_id.startswith("check-"):
            number = classroom.number_of(grade_id)
            with pytest.raises(NotImplementedError, match=f"^Exercise {number}: "):
                kernel.run("".join(cell["source"]))
            failed.append(number)
        else:
            kernel.run("".join(cell["source"]))
    assert list(dict.fromkeys(failed)) == [
        f"{int(solution.stem[:2])}.{n + 1}" for n in range(len(parts(solution)))]


@each_solution
def test_every_check_is_folded_behind_a_line_that_says_what_it_is(solution):
    folded = {}
    for cell in json.loads(exercise_of(solution))["cells"]:
        grade_id = cell["metadata"].get("nbgrader", {}).get("grade_id", "")
        if grade_id.startswith("check-"):
            assert cell["metadata"]["jupyter"] == {"source_hidden": True}
            folded[classroom.number_of(grade_id)] = cell["source"][0]
    for number, line in folded.items():
        assert line.startswith(f"# The check of exercise {number}: ")
    assert len(folded) == len(parts(solution))


# --- What an exercise must not tell ---------------------------------------------------


def told(source):
    """The lines of a text that say something: not the short ones, no imports."""
    lines = (line.split("  #")[0].strip() for line in source.splitlines())
    return {line for line in lines
            if len(line) > 12 and not line.startswith(("from ", "import "))}


def leaks(solution, exercise):
    """Lines of answers, hidden tests and lecturer's cells that stand in the exercise.

    What also stands in code for everybody is no secret.
    """
    secret, known = set(), set()
    for cell in read(solution).cells:
        source = cell.source
        if classroom.SOLUTION_TAG in cell.metadata.get("tags", []):
            secret |= told(source)
            continue
        for marker in MARKERS.values():
            for hidden in marker.findall(source):
                secret |= told(hidden)
            source = marker.sub("", source)
        if cell.cell_type == "code":
            known |= told(source)
    secret = {line for line in secret if not any(line in other for other in known)}
    assert secret
    exercise = json.loads(exercise)
    for cell in exercise["cells"]:
        cell["source"] = "".join(cell["source"])
    text = json.dumps(exercise, ensure_ascii=False)
    return {line for line in secret
            if json.dumps(line, ensure_ascii=False)[1:-1] in text}


@each_solution
def test_no_answer_hidden_test_or_analysis_leaks_into_the_exercise(solution):
    exercise = exercise_of(solution)
    assert leaks(solution, exercise) == set()
    assert "### BEGIN" not in exercise and "### END" not in exercise


@pytest.mark.parametrize("place", ["source", "metadata", "outputs", "of the notebook"])
def test_a_leak_would_be_seen(place):
    solution, answer = SOLUTIONS[0], "after = reward[t] + gamma * after"
    exercise = json.loads(exercise_of(solution))
    cell = next(cell for cell in exercise["cells"] if cell["cell_type"] == "code")
    if place == "source":
        cell["source"] += ["\n", f"    {answer}\n"]
    elif place == "metadata":
        cell["metadata"]["note"] = [answer]
    elif place == "outputs":
        cell["outputs"] = [{"output_type": "stream", "name": "stdout", "text": answer}]
    else:
        exercise["metadata"]["kept"] = {"answer": answer}
    assert leaks(solution, json.dumps(exercise)) == {answer}


@each_solution
def test_an_exercise_holds_no_outputs_and_no_other_metadata(solution):
    exercise = json.loads(exercise_of(solution))
    assert exercise["metadata"].keys() == {"kernelspec", "language_info"}
    for cell in exercise["cells"]:
        assert cell["metadata"].keys() <= {"nbgrader", "deletable", "editable",
                                           "jupyter"}
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None


# --- What checks say ------------------------------------------------------------------


def says(value, expected, **more):
    with pytest.raises(AssertionError) as caught:
        classroom.close(value, expected, "y", **more)
    return str(caught.value)


def test_close_returns_a_list_as_an_array():
    value = classroom.close([1, 2], [1.0, 2.0], "y")
    assert isinstance(value, np.ndarray) and value.tolist() == [1.0, 2.0]


def test_close_accepts_what_is_close_and_of_the_same_shape():
    classroom.close([1, 2 + 1e-9], np.array([1.0, 2.0]), "y")
    classroom.close(3, 3.0, "y")
    classroom.close(101.0, 100.0, "y", rtol=0.02)
    classroom.close(np.float32(49.9625), 49.9625, "y")


def test_close_says_place_number_and_expected_number():
    assert says([[1, 2], [3, 9]], [[1, 2], [3, 4]]) == "y has 9 at [1, 1]: expected 4."
    assert says(0.5, 2.0) == "y is 0.5: expected 2."


def test_close_names_the_number_that_is_wrong_in_digits_that_differ():
    assert says(1.000004, 1.0) == "y is 1.000004: expected 1."
    assert says([1e6 + 0.5, 1.1], [1e6, 1]) == "y has 1.1 at [1]: expected 1."


def test_close_never_broadcasts():
    assert says(np.ones((3, 1)), np.ones(3)) == "y has shape (3, 1): expected (3,)."
    assert says(1.0, [1.0]) == "y has shape (): expected (1,)."


def test_close_knows_none_words_and_nan():
    assert says(None, 1.0) == "y is None. Does your function end in `return`?"
    assert says("up", 1.0) == "y is a str: expected numbers of shape ()."
    assert says([1, np.nan], [1, 2]) == "y holds nan: expected finite numbers."


def test_close_names_the_mistake_that_was_made():
    mistakes = {"A sum, not a mean.": 4.0, "One row each.": [2.0, 2.0]}
    assert says(4.0, 2.0, mistakes=mistakes) == "y is 4: expected 2. A sum, not a mean."
    assert says([2, 2], 2.0, mistakes=mistakes).endswith("expected (). One row each.")
    assert says(5.0, 2.0, mistakes=mistakes) == "y is 5: expected 2."


def test_claim_says_its_sentence():
    classroom.claim(True, "never said")
    with pytest.raises(AssertionError, match="^two are missing$"):
        classroom.claim(False, "two are missing")
