"""A course with nbgrader, from solutions to feedback, as solutions/README.md says.

Three students hand in: one nothing, one everything right, and one a single right answer
with every check overwritten by `assert True`.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
GUIDE = (ROOT / "solutions" / "README.md").read_text(encoding="utf-8")
(WALK,) = (block for block in re.findall(r"^```sh\n(.*?)^```$", GUIDE, re.M | re.S)
           if "nbgrader autograde" in block)
COMMANDS = [line.split("  #")[0].split() for line in WALK.splitlines()]
EXERCISE = ROOT / "exercises" / "01_value.ipynb"
POINTS = {"anna": 0, "bo": 14, "chris": 2}
# All lines in one process, since nbgrader takes five seconds to start.
WALKER = """
import json, os, sys
from nbgrader.apps import NbGraderApp
from dnddpg_minimal import classroom
for line in json.loads(sys.argv[1]):
    match line:
        case ["cd", folder]:
            os.chdir(folder)
        case ["python", "-m", "dnddpg_minimal.classroom", *words]:
            assert classroom.main(words) == 0
        case ["nbgrader", *words]:
            NbGraderApp.clear_instance()
            NbGraderApp.launch_instance(words)
        case _:
            sys.exit(f"not understood: {line}")
"""


def grade_id(cell):
    return cell["metadata"].get("nbgrader", {}).get("grade_id", "")


def hand_in(solved, folder, student):
    """What this student makes of the exercise."""
    nb = json.loads(EXERCISE.read_text(encoding="utf-8"))
    for cell in nb["cells"]:
        name = grade_id(cell)
        done = {"anna": (), "bo": solved, "chris": ("exercise-1-1",)}[student]
        if name.startswith("exercise-") and name in done:
            cell["source"] = solved[name]
        if student == "chris" and name.startswith("check-"):
            cell["source"] = "assert True"
    path = folder / student / "01_value" / "01_value.ipynb"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(nb), encoding="utf-8")


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    """The folder of a course after the guide's commands for chapter 01."""
    above = tmp_path_factory.mktemp("lecture")
    solution = json.loads((ROOT / "solutions/01_value.ipynb").read_text("utf-8"))
    solved = {grade_id(cell): cell["source"] for cell in solution["cells"]}
    for student in POINTS:
        hand_in(solved, above / "course" / "submitted", student)
    bin_ = Path(sys.executable).parent  # autograde calls alembic by name
    environment = os.environ | {"PATH": f"{bin_}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run([sys.executable, "-c", WALKER, json.dumps(COMMANDS)],
                          cwd=above, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    return above / "course"


def test_what_is_released_is_the_exercise_of_this_repository(course):
    released = (course / "release/01_value/01_value.ipynb").read_text("utf-8")
    assert json.loads(released) == json.loads(EXERCISE.read_text("utf-8"))


def test_everybody_gets_the_points_of_what_is_right(course):
    rows = (course / "grades.csv").read_text("utf-8").splitlines()
    names, *rows = (row.split(",") for row in rows)
    table = [dict(zip(names, row, strict=True)) for row in rows]
    assert {row["student_id"]: float(row["score"]) for row in table} == POINTS
    assert {float(row["max_score"]) for row in table} == {14}


def test_an_overwritten_check_is_put_back_and_its_hidden_tests_run(course):
    graded = json.loads((course / "autograded/chris/01_value/01_value.ipynb")
                        .read_text("utf-8"))
    checks = ["".join(cell["source"]) for cell in graded["cells"]
              if grade_id(cell).startswith("check-")]
    assert len(checks) == 4
    assert all("BEGIN HIDDEN TESTS" in check for check in checks)


def test_the_feedback_says_what_is_wrong_in_a_sentence(course):
    for student, points in POINTS.items():
        page = (course / "feedback" / student / "01_value/01_value.html")
        text = page.read_text(encoding="utf-8")
        assert f"Score: {points:.1f} / 14.0" in text
        assert ("Exercise 1.2: not done yet" in text) == (points < 14)
