"""Chapter 12's line-up: answers are checked, and none is given away."""

import pytest

from dnddpg_minimal import Config, suspects
from dnddpg_minimal.bugs import BUGS
from dnddpg_minimal.study import Run, record

RIGHT = {letter: [name for name in suspects.SUSPECTS
                  if suspects.check(letter, name).startswith("right")]
         for letter in suspects.LETTERS}


def test_each_letter_has_one_right_answer_and_no_two_share_it():
    assert all(len(names) == 1 for names in RIGHT.values())
    assert {name for names in RIGHT.values() for name in names} == set(BUGS)


def test_a_wrong_answer_gets_a_hint_that_names_nobody():
    for letter in suspects.LETTERS:
        for name in set(suspects.SUSPECTS) - set(RIGHT[letter]):
            sentence = suspects.check(letter, name)
            assert sentence.startswith("not this one: ")
            assert not any(other in sentence for other in BUGS)


def test_without_an_answer_it_says_so():
    assert suspects.check("A") == suspects.check("F", None) == "no answer yet"


@pytest.mark.parametrize("letter", ["G", "", "AB"])
def test_an_unknown_letter_is_refused(letter):
    with pytest.raises(ValueError, match="expected one of"):
        suspects.check(letter)


def test_a_misspelt_name_gets_the_names_and_stops_nothing():
    said = suspects.check("A", "timelimit")
    assert said.startswith("'timelimit' is no suspect: expected one of time_limit,")


def test_what_is_loaded_carries_the_letter_and_not_the_fault(tmp_path):
    small = dict(steps=400, warmup=200, evaluate_every=200, hidden=(8, 8), batch_size=8)
    config = Config("Pendulum-v1", "DDPG", ends="any_end", **small)
    record(Run(config, "bug=time_limit", "time_limit"), tmp_path, tmp_path / "scratch")
    (letter,) = [letter for letter in suspects.LETTERS
                 if len(suspects.load(letter, folder=tmp_path))]
    assert RIGHT[letter] == ["time_limit"]
    assert set(suspects.load(letter, folder=tmp_path).variant) == {letter}
    (run,) = suspects.load(letter, "episodes", tmp_path)
    assert run["variant"] == letter and "time_limit" not in str(run)
    assert suspects.task_of(letter) == "Pendulum-v1"
