"""`python -m dnddpg_minimal check`: points, sentences, and what does not fool it."""

import contextlib
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from nbclient.exceptions import CellTimeoutError

from dnddpg_minimal import check
from dnddpg_minimal.__main__ import main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
EXERCISE = ROOT / "exercises" / "01_value.ipynb"
SOLUTION = ROOT / "solutions" / "01_value.ipynb"


def content(path):
    return json.loads(path.read_text(encoding="utf-8"))


def cell_of(nb, grade_id):
    return next(cell for cell in nb["cells"]
                if cell["metadata"].get("nbgrader", {}).get("grade_id") == grade_id)


def handed_in(folder, **sources):
    """The solved notebook of chapter 01, as a student's, with other sources in it.

    Names are grade ids with _ for -. A source of None deletes the cell.
    """
    exercise, solved = content(EXERCISE), content(SOLUTION)
    for cell in list(exercise["cells"]):
        grade_id = cell["metadata"].get("nbgrader", {}).get("grade_id", "")
        if grade_id.startswith("exercise-"):
            cell["source"] = cell_of(solved, grade_id)["source"]
        if grade_id.replace("-", "_") in sources:
            cell["source"] = sources[grade_id.replace("-", "_")]
            if cell["source"] is None:
                exercise["cells"].remove(cell)
    path = folder / "handed_in.ipynb"
    path.write_text(json.dumps(exercise), encoding="utf-8")
    return path


# --- In a kernel ----------------------------------------------------------------------


def test_nothing_done_earns_nothing_and_exits_with_1(capsys):
    assert main(["check", str(EXERCISE)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(
        "checks of solutions/01_value.ipynb, hidden tests included")
    assert lines[1:3] == ["Exercise 1.1: 0 of 2 points",
                          "    not done yet: a raise NotImplementedError is left"]
    assert lines[-1] == "Together: 0 of 14 points"


def test_right_wrong_slow_and_tampered_answers_in_one_notebook(tmp_path, capsys):
    path = handed_in(
        tmp_path,
        check_1_1=None,  # deleted, with a right answer above
        exercise_1_2="def td_target(reward, terminated, truncated, q_next, gamma):\n"
                     "    return reward + gamma * q_next\n",
        check_1_2="assert True",
        exercise_1_3="def layer_backward(x, W, b, dh):\n"
                     "    while True:\n        pass\n",
        exercise_1_4="def n_step_target(:\n",
    )
    before = path.read_bytes()
    assert main(["check", str(path), "--seconds", "8"]) == 1
    assert path.read_bytes() == before
    lines = capsys.readouterr().out.splitlines()[1:]
    assert lines[:3] == [
        "Exercise 1.1: 2 of 2 points",
        "Exercise 1.2: 0 of 4 points",
        "    y has 11 at [1]: expected 2. Nothing follows after a real end, so y is "
        "the reward there.",
    ]
    assert lines[3:5] == ["Exercise 1.3: 0 of 4 points", "    ran longer than 8 s"]
    assert lines[5] == "Exercise 1.4: 0 of 4 points"
    assert lines[6].startswith("    the cell above its check: SyntaxError: ")
    assert lines[7].startswith("    NameError: ")
    assert lines[8:] == ["Together: 2 of 14 points"]


def test_the_whole_notebook_has_a_time_limit(tmp_path, capsys):
    slow = "import time\n\ntime.sleep(60)\n"
    path = handed_in(tmp_path, exercise_1_1=slow, exercise_1_2=slow)
    assert main(["check", str(path), "--total", "3"]) == 1
    out = capsys.readouterr().out
    assert "was not run: the time for the whole notebook was over" in out
    assert out.endswith("Together: 0 of 14 points\n")


def test_a_cell_that_hangs_takes_no_points_away_from_the_cells_before(monkeypatch):
    clock = [0.0]

    class Client:  # a cell is the number of seconds that it takes
        def setup_kernel(self, **_):
            return contextlib.nullcontext()

        def execute_cell(self, cell, index):
            clock[0] += min(cell.seconds, self.timeout)
            if cell.seconds > self.timeout:
                raise CellTimeoutError

    monkeypatch.setattr(check, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(check, "fresh_client", lambda *_: Client())
    cells = [SimpleNamespace(seconds=s, outputs=[]) for s in (5, 1, 1_000, 1)]
    errors = check.run(cells, None, seconds=6, total=14)
    assert errors == {2: ("", "ran longer than 6 s"), 3: ("", check.NOT_RUN)}


def test_without_solutions_a_changed_check_earns_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(check, "ROOT", tmp_path)
    path = handed_in(tmp_path, check_1_2="assert True")
    assert main(["check", str(path)]) == 1
    first, *lines = capsys.readouterr().out.splitlines()
    assert first.endswith("its own checks (there is no solution of it here)")
    assert "Exercise 1.1: 2 of 2 points" in lines
    assert lines[lines.index("Exercise 1.2: 0 of 4 points") + 1] == (
        "    its check was changed: take the notebook afresh")
    assert lines[-1] == "Together: 10 of 14 points"


# --- Without one ----------------------------------------------------------------------


def prepared(path):
    nb = check.read(path)
    source, _ = check.source_of(nb, path)
    return check.with_checks_of(source, nb)


def test_hidden_tests_given_code_and_the_order_of_cells_are_restored(tmp_path):
    path = handed_in(tmp_path, given_1_4="gamma = 0", check_1_3="", check_1_2=None)
    nb = content(path)  # and the student has tried something at the end
    nb["cells"].append({"cell_type": "code", "id": "mine", "metadata": {},
                        "outputs": [], "execution_count": 1, "source": "1 + 1"})
    path.write_text(json.dumps(nb), encoding="utf-8")
    (*cells, mine), changed = prepared(path)
    assert mine.source == "1 + 1"
    original, _ = prepared(SOLUTION)
    assert [check.id_of(cell) for cell in cells] == [
        check.id_of(cell) for cell in original]
    assert [cell.source for cell in cells] == [cell.source for cell in original]
    assert changed == set()


def test_a_copied_check_counts_once_and_a_check_of_ones_own_not_at_all(tmp_path):
    nb = content(EXERCISE)
    copied = json.loads(json.dumps(cell_of(nb, "check-1-1"))) | {"id": "copy"}
    own = json.loads(json.dumps(copied)) | {"id": "own", "source": "assert True"}
    own["metadata"]["nbgrader"] |= {"grade_id": "check-1-9", "points": 100}
    nb["cells"] += [copied, own]
    path = tmp_path / "anna.ipynb"
    path.write_text(json.dumps(nb), encoding="utf-8")
    results = check.exercises(prepared(path)[0], {})
    assert sum(possible for _, possible, _ in results.values()) == 14


def test_a_notebook_is_known_by_its_checks_not_by_its_name(tmp_path):
    path = shutil.copy(EXERCISE, tmp_path / "homework of anna.ipynb")
    nb = check.read(path)
    assert "solutions/01_value.ipynb" in check.source_of(nb, path)[1]


@pytest.mark.parametrize("folder", ["exercises", "my", "anna"])
def test_a_notebook_that_lost_its_metadata_gets_the_checks_at_its_end(tmp_path, folder):
    nb = content(EXERCISE)
    for cell in nb["cells"]:
        cell["metadata"] = {}
    path = tmp_path / folder / "01_value.ipynb"
    path.parent.mkdir()
    path.write_text(json.dumps(nb), encoding="utf-8")
    cells, _ = prepared(path)
    original = [cell for cell in check.read(SOLUTION).cells if check.is_locked(cell)]
    assert [cell.source for cell in cells[-len(original):]] == [
        cell.source for cell in original]


def test_a_chapter_of_the_same_name_is_no_exercise(monkeypatch):
    monkeypatch.chdir(ROOT / "notebooks")  # the folder's name is not in the path
    with pytest.raises(ValueError, match="holds no exercise with a check"):
        prepared(Path("01_value.ipynb"))


def test_a_forgotten_return_is_named():
    ask = "Does your function end in `return`?"
    assert check.in_words("TypeError", "object of type 'NoneType' has no len()") == (
        f"TypeError: object of type 'NoneType' has no len(). {ask}")
    assert check.in_words("AssertionError", "f gave a NoneType: expected two.") == (
        f"f gave a NoneType: expected two. {ask}")
    assert check.in_words("TypeError", "can't multiply") == "TypeError: can't multiply"


@pytest.mark.parametrize("text, words", [
    ("{\"cells\": [", "is no notebook, or damaged"),
    ("[1, 2]", "holds no list of cells"),
    ('{"cells": [{"cell_type": "pie"}], "metadata": {}, "nbformat": 4, '
     '"nbformat_minor": 5}', "is a damaged notebook"),
    ('{"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}',
     "holds no exercise with a check"),
])
def test_a_damaged_file_gets_one_line_and_exit_code_2(tmp_path, capsys, text, words):
    path = tmp_path / "a.ipynb"
    path.write_text(text, encoding="utf-8")
    assert main(["check", str(path)]) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and shown.err.count("\n") == 1
    assert words in shown.err and "a.ipynb" in shown.err


def test_no_such_file_and_no_time_get_one_line_and_exit_code_2(tmp_path, capsys):
    for words in ([tmp_path / "nowhere.ipynb"], [tmp_path],
                  [EXERCISE, "--seconds", "0"]):
        assert main(["check", *map(str, words)]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_several_notebooks_are_checked_and_their_points_collected(tmp_path, capsys):
    import pandas as pd

    two = handed_in(tmp_path), tmp_path / "empty.ipynb"
    shutil.copy(EXERCISE, two[1])
    broken = tmp_path / "broken.ipynb"
    broken.write_text("no notebook", encoding="utf-8")
    table = tmp_path / "points.csv"
    assert check.main([str(two[0]), str(broken), str(two[1]), "--csv", str(table)]) == 2
    said = capsys.readouterr().out
    assert said.count("Together: ") == 2 and f"{broken}: left out." in said
    rows = pd.read_csv(table)
    assert rows.groupby("notebook").points.sum().to_dict() == {
        str(two[0]): 14, str(two[1]): 0}
    assert rows.groupby("notebook").possible.sum().tolist() == [14, 14]
    assert rows.said[rows.points == 0].str.startswith("not done yet").all()


def test_a_table_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    with pytest.raises(ValueError, match="there is no folder"):
        check.main([str(tmp_path / "x.ipynb"), "--csv", str(tmp_path / "no" / "p.csv")])
    with pytest.raises(ValueError, match="no notebook named"):
        check.main([])
