"""Chapter 12's line-up: six faulty agents under letters, and a check that keeps quiet.

    load(letter, what)    what was recorded of the agent behind a letter
    check(letter, name)   one sentence: right; wrong, and why that name does not fit; or
                          no answer yet
    SUSPECTS              the names to choose from: what each of them did

Which fault hides behind which letter is written nowhere: the letters are dealt out in
the order of a hash, and an answer is compared by its hash. Reading this file gives
nothing away. (Computing hashes does. So does looking up the answer; both are allowed,
neither teaches anything.)
"""

import hashlib

from dnddpg_minimal import records
from dnddpg_minimal.bugs import BUGS

LETTERS = "ABCDEF"
SALT = "hear it"  # decides who gets which letter
ANSWERS = {  # letter: the hash of its right answer
    "A": "8eab835b6ce5630f951d982815571a51467631bfd06eca8450a68d4ec1f36f08",
    "B": "042edda6049365989318c4b2970069030eb590e38150e2f99f11005ba1618749",
    "C": "1f88e52ccf6351499c2c4a55de73e3f549ceaba57cecb1db3a837e77a0ba0c70",
    "D": "9e19331b3f65292908c010fee2141cfa18214649ede16e65d72b5906d17f74a5",
    "E": "36e1ddbd0d8cfeb39978171ed8ab7404bb214881fd5b61d6c65038412aabf98b",
    "F": "a06864af5d003d2cfa5cacb5261733939ca3343c0f954ec7beb915af5cdab3fb",
}

# name: (what it did, what one would then have measured). Six are guilty, four are not.
SUSPECTS = {
    "time_limit": (
        "stores the time limit as an end of the world",
        "one target in 200 would then be far from the others, Eq. (12.1): a loss "
        "several times the right agent's, beside a return that mostly ends as it "
        "should. Look at both columns together"),
    "one_seed": (
        "starts every episode from the same state",
        "all episodes of training would then begin alike, and their returns would "
        "hardly differ. Look at the spread of the returns in training, and at tests "
        "from other starts"),
    "lost_axis": (
        "compares q of shape (B, 1) with y of shape (B,)",
        "every q would then be drawn to the mean of y, and Q would be the same in all "
        "states, to a unit or two. Compare Q at starts with Q at visited states"),
    "env_units": (
        "stores the action in the task's units, and asks in [-1, 1]",
        "the critic would then judge a policy with half of the torque. Ask whether it "
        "expects too little from its own, stronger policy"),
    "through_y": (
        "lets the gradient flow through y, with no slow copies",
        "the loss would then be smaller than the right agent's, for y is moved towards "
        "q, and yet little would be learned for most of the run, in practice as in "
        "tests. Look at the loss and at practice together"),
    "no_end": (
        "forgets that the world ended: every target goes on",
        "Q would then be fed by its own guess about states that nobody leaves. That "
        "needs a task whose world can end, and Q leaves all that the task can pay"),
    "no_noise": (
        "does not explore after the first 1 000 steps",
        "every column would then read nearly as that of the right agent: on Pendulum "
        "this noise is hardly needed (chapter 03). Find the column that does not"),
    "no_replay": (
        "learns from the newest transitions only",
        "the critic would then forget whatever it has not just seen: Q far above the "
        "truth, with a loss no larger than the right agent's, since the newest rows "
        "are easy to fit. Compare Q, truth and loss"),
    "no_slow_copy": (
        "computes y with the networks that learn",
        "targets would then run after themselves: a loss many times the right agent's, "
        "and a return that rises and breaks down again and again. Look at both"),
    "none": (
        "did nothing wrong",
        "every instrument would then read as that of the right agent on the same task. "
        "Find the one that does not"),
}


def _hash(*words):
    return hashlib.sha256(":".join((SALT, *words)).encode()).hexdigest()


def _dealt():
    """The faults in the order of the letters."""
    return sorted(BUGS, key=_hash)


def load(letter, what="evaluations", folder=None):
    """`records.load_study` of the agent behind a letter; its variant reads `letter`.

    what, folder: as in `load_study`. Raises ValueError for an unknown letter.
    """
    fault = _dealt()[_place(letter)]
    found = records.load_study(algorithm="DDPG", variant=f"bug={fault}", what=what,
                               folder=folder)
    if isinstance(found, list):
        return [one | {"variant": letter} for one in found]
    return found.assign(variant=letter)


def task_of(letter):
    """The task on which the agent behind a letter was trained.

    Raises ValueError for an unknown letter.
    """
    return BUGS[_dealt()[_place(letter)]][0]


def _place(letter):
    if letter not in LETTERS or len(letter) != 1:
        raise ValueError(f"letter={letter!r}: expected one of {', '.join(LETTERS)}.")
    return LETTERS.index(letter)


def check(letter, name=None):
    """One sentence about the answer `name` for a letter. Tells no right answer.

    A misspelt name gets the list of names. Raises ValueError for an unknown letter.
    """
    _place(letter)
    if name is None:
        return "no answer yet"
    if name not in SUSPECTS:
        return f"{name!r} is no suspect: expected one of {', '.join(SUSPECTS)}"
    if _hash(letter, name) == ANSWERS[letter]:
        return f"right: it {SUSPECTS[name][0]}"
    return f"not this one: {SUSPECTS[name][1]}"
