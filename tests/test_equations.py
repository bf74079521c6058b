"""Equation numbers: the table on top of `dnddpg.py`, its code, and these tests agree.

A line of the table reads `(11) y = ...   td_target, choose_actor`: the equation's
number, what it says, and which functions it lies in. In the code the tag is `Eq. (11)`.
"""

import ast
import inspect
import re
from functools import reduce
from pathlib import Path

import pytest

from dnddpg_minimal import dnddpg

SOURCE = inspect.getsource(dnddpg)
ROW = r"^ +\((\d+)\)(?:-\((\d+)\))? +(.+?) {2,}(.+)$"
TABLE = re.findall(ROW, dnddpg.__doc__, re.M)
CODE = SOURCE.replace(dnddpg.__doc__, "", 1)
TAG = re.compile(r"Eqs?\. \((\d+)\)")


def look_up(name):
    """The object of a name such as `NumpyAgent.update`, or None."""
    try:
        return reduce(getattr, name.split("."), dnddpg)
    except AttributeError:
        return None


def places():
    """Equation number → the functions of `dnddpg.py` that the table names for it."""
    return {int(first): [name for name in re.findall(r"[\w.]*\w", where)
                         if callable(look_up(name)) and name != "Training"]
            for first, _, _, where in TABLE}


def test_the_table_goes_through_the_papers_twelve_equations_in_order():
    covered = [n for first, last, _, _ in TABLE
               for n in range(int(first), int(last or first) + 1)]
    assert covered == list(range(1, 13))


@pytest.mark.parametrize("number", [1, 3, 4, 11, 12])
def test_the_equations_that_are_code_have_a_place_in_the_table(number):
    assert places()[number]


def test_every_function_that_the_table_names_carries_the_equations_tag():
    for number, names in places().items():
        for name in names:
            tags = TAG.findall(inspect.getsource(look_up(name)))
            assert str(number) in tags, f"{name} has no 'Eq. ({number})'"


def test_every_tag_in_the_code_is_in_the_table():
    in_code = {int(number) for number in TAG.findall(CODE)}
    in_table = {number for number, names in places().items() if names}
    assert in_code == in_table


def test_an_update_follows_the_equations_in_the_contracts_order():
    """Critics, then actors, then slow copies; each agent has the two halves."""
    tags = TAG.findall(inspect.getsource(dnddpg.Agent.update))
    assert tags == ["3", "4", "1"]
    for agent in (dnddpg.NumpyAgent, dnddpg.TorchAgent):
        assert "update" not in vars(agent)  # one body, for both
        assert TAG.findall(inspect.getsource(agent.fit_critics)) == ["3"]
        assert TAG.findall(inspect.getsource(agent.climb_critics)) == ["4"]


def test_the_file_reads_from_top_to_bottom():
    """No function and no class names another one that comes later in the file."""
    tree = ast.parse(SOURCE)
    line = {node.name: node.lineno for node in tree.body
            if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    later = {(name, user.id) for name, begin in line.items()
             for node in tree.body if getattr(node, "name", None) == name
             for user in ast.walk(node) if isinstance(user, ast.Name)
             and line.get(user.id, begin) > begin}
    assert not later


def test_every_equation_that_is_code_is_named_by_a_test():
    tests = "".join(path.read_text(encoding="utf-8")
                    for path in Path(__file__).parent.glob("test_*.py")
                    if path != Path(__file__))
    for number, names in places().items():
        if names:
            assert re.search(rf"Eq\. \({number}\)", tests), f"Eq. ({number})"
