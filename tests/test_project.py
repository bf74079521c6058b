"""The project as a whole: its commands, its pins, its notebooks, its files."""

import ast
import dataclasses
import importlib
import inspect
import json
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import dnddpg_minimal

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
REQUIREMENTS = [line for line in (ROOT / "requirements.txt").read_text().splitlines()
                if line and not line.startswith("#")]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NOTEBOOKS = [path for folder in ("notebooks", "solutions")
             for path in sorted((ROOT / folder).glob("*.ipynb"))]
TEXT = {".py", ".md", ".toml", ".txt", ".cff", ".ipynb", ".json", ".yml", ""}
MACHINE_PATH = re.compile(
    r"(?<![\w.])(?:/(?:work|tmp|root|home|opt|Users)/|[A-Z]:\\\\?Users)[\w./\\-]*")


def project_files():
    """Every text file of the project, whether git knows it yet or not."""
    folders = [ROOT / name for name in ("dnddpg_minimal", "tests", "notebooks",
                                        "solutions", "exercises", ".ci")]
    found = [path for path in ROOT.iterdir() if path.is_file()]
    found += [path for folder in folders for path in folder.rglob("*")]
    return [path for path in found
            if path.is_file() and path.suffix in TEXT and path.name != ".git"
            and not {"__pycache__", ".ipynb_checkpoints"} & set(path.parts)]


def code_blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.M | re.S)


# --- two commands ---------------------------------------------------------------------


def test_the_readme_gives_two_complete_commands_of_one_line_each():
    read, check = [block for block in code_blocks("sh") if "-m venv" in block]
    for command in (read, check):
        assert command.count("\n") == 1
        assert command.startswith("python3 -m venv .venv && ")
        assert "pip install -r requirements.txt" in command
    # A file instead would make notebooks/ the root (no films, no links to exercises),
    # and the printed address, for a browser elsewhere, would not open it
    assert read.endswith(" -m jupyterlab --LabApp.default_url=/lab/tree/notebooks/"
                         "00_start_here.ipynb\n")
    assert "pytest --nbval" in check


def test_windows_has_the_same_two_commands():
    unix = [block for block in code_blocks("sh") if "-m venv" in block]
    translated = [command.replace("python3", "py -3").replace(" &&", ";")
                  .replace(".venv/bin/", ".venv\\Scripts\\") for command in unix]
    assert "".join(code_blocks("powershell")) == "".join(translated)


@pytest.mark.skipif(not shutil.which("bash") or os.name == "nt", reason="needs bash")
def test_ci_runs_the_second_command_of_the_readme():
    shown = subprocess.run(["bash", ROOT / ".ci" / "run", "--print"], text=True,
                           capture_output=True, check=True).stdout
    assert shown in code_blocks("sh")
    assert shown.rstrip().endswith("-m pytest --nbval")


def test_pytest_without_a_path_collects_tests_notebooks_and_solutions():
    options = PROJECT["tool"]["pytest"]["ini_options"]
    assert options["testpaths"] == ["tests", "notebooks", "solutions"]


def test_the_readme_stays_short_and_names_only_what_exists():
    assert len(README.splitlines()) < 150
    linked = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    named = re.findall(r"`((?:dnddpg_minimal|notebooks|tests)/[^`]*)`", README)
    for name in linked + named:
        assert (ROOT / name).exists(), name


def test_the_readmes_python_runs(tmp_path):
    (code,) = code_blocks("python")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, text=True,
                          capture_output=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "pendulum.npz").exists()


# --- installation ---------------------------------------------------------------------


def test_requirements_are_exact_pins_and_install_the_package_last():
    *pins, last = REQUIREMENTS
    assert last == "-e ."
    for pin in pins:
        assert re.fullmatch(r"[a-z0-9-]+(\[[a-z,-]+\])?==\d+(\.\d+)+", pin), pin


def test_what_the_package_needs_is_pinned():
    def name(requirement):
        return re.match(r"[a-z0-9-]+(\[[a-z,-]+\])?", requirement)[0]

    def extras(requirement):
        return sorted(re.findall(r"[a-z0-9-]+", name(requirement)))

    needed = [extras(line) for line in PROJECT["project"]["dependencies"]]
    pinned = [extras(line) for line in REQUIREMENTS[:-1]]
    assert [names for names in needed if names not in pinned] == []


def test_importing_the_package_is_light():
    heavy = {"torch", "pandas", "matplotlib.pyplot", "mujoco", "pygame", "scipy"}
    code = f"import sys, dnddpg_minimal; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True,
                          check=True)
    assert done.stdout.strip() == "[]"


# --- files ----------------------------------------------------------------------------


def test_ruff_finds_nothing():
    done = subprocess.run([sys.executable, "-m", "ruff", "check", "--no-cache", ROOT],
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_lines_end_in_lf_and_files_end_in_a_line():
    for path in project_files():
        content = path.read_bytes()
        assert b"\r\n" not in content, path
        assert not content or content.endswith(b"\n"), path


def test_no_file_or_notebook_names_a_folder_of_somebodys_machine():
    for path in project_files():
        text = path.read_text(encoding="utf-8")
        assert path == Path(__file__) or not MACHINE_PATH.search(text), path


# --- notebooks ------------------------------------------------------------------------


def code_cells(notebook):
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells
            if cell["cell_type"] == "code" and "".join(cell["source"]).strip()]


each_notebook = pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)


@each_notebook
def test_every_code_cell_was_run_in_order(notebook):
    # nbval passes a notebook that was never run, without a word.
    counts = [cell["execution_count"] for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1))


@each_notebook
def test_no_stored_output_is_an_error_or_a_warning(notebook):
    for cell in code_cells(notebook):
        expected = "nbval-raises-exception" in cell["metadata"].get("tags", [])
        for output in cell["outputs"]:
            assert output["output_type"] != "error" or expected, output["ename"]
            assert output.get("name") != "stderr", output["text"]


# --- documentation --------------------------------------------------------------------


def public_things():
    """(name, object) of every public function, class and method of the package."""
    for module in pkgutil.walk_packages(dnddpg_minimal.__path__, "dnddpg_minimal."):
        for name, thing in vars(importlib.import_module(module.name)).items():
            if name.startswith("_") or getattr(thing, "__module__", "") != module.name:
                continue
            if inspect.isfunction(thing) or inspect.isclass(thing):
                yield f"{module.name}.{name}", thing
            if inspect.isclass(thing):
                for part, member in vars(thing).items():
                    kinds = (property, classmethod, staticmethod)
                    if not part.startswith("_") and (inspect.isfunction(member)
                                                     or isinstance(member, kinds)):
                        yield f"{module.name}.{name}.{part}", getattr(thing, part)


def test_every_public_name_has_a_docstring():
    """A method may inherit it from its base class."""
    silent = [name for name, thing in public_things() if not inspect.getdoc(thing)]
    assert not silent


def exported_functions():
    """(name, function, what is said of it) of all that the package exports.

    Of a class these are its methods, inherited ones too; what is said may stand in the
    method's docstring or in the class's. The fields of a Config, a Batch or a Record
    have comments instead.
    """
    for name in dnddpg_minimal.__all__:
        thing = getattr(dnddpg_minimal, name)
        if inspect.isfunction(thing):
            yield name, thing, inspect.getdoc(thing)
        if inspect.isclass(thing):
            said = [inspect.getdoc(one) for one in thing.__mro__
                    if one.__module__.startswith("dnddpg_minimal")]
            if not (dataclasses.is_dataclass(thing) or hasattr(thing, "_fields")):
                yield f"{name}.__init__", thing.__init__, " ".join(said)
            for part, member in inspect.getmembers(thing, inspect.isroutine):
                where = getattr(member, "__module__", None) or ""
                if not part.startswith("_") and where.startswith("dnddpg_minimal"):
                    own = inspect.getdoc(member) or ""
                    yield f"{name}.{part}", member, " ".join([own, *said])


EXPORTED = {name: (thing, said) for name, thing, said in exported_functions()}


@pytest.mark.parametrize("name", EXPORTED)
def test_the_docstring_of_an_exported_function_names_its_arguments(name):
    thing, said = EXPORTED[name]
    words = inspect.signature(thing).parameters.keys() - {"self"}
    symbols = {"gamma": "γ", "nu": "ν"}
    missing = [word for word in words
               if not re.search(rf"\b({word}|{symbols.get(word, word)})\b", said)]
    assert not missing


def functions_that_refuse():
    """(name, what is said of it) of public functions with a `raise ValueError` inside.

    A constructor is described by its class, what sets a property by what gets it.
    """
    for path in sorted(Path(dnddpg_minimal.__file__).parent.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        owners = [tree, *(one for one in tree.body if isinstance(one, ast.ClassDef))]
        for owner in owners:
            inside = [one for one in owner.body if isinstance(one, ast.FunctionDef)]
            for one in inside:
                if one.name.startswith("_") and one.name != "__init__":
                    continue
                raised = [ast.unparse(part.exc).partition("(")[0]
                          for part in ast.walk(one)
                          if isinstance(part, ast.Raise) and part.exc]
                if "ValueError" in raised:
                    about = [owner] if one.name == "__init__" else [
                        other for other in inside if other.name == one.name]
                    place = [path.stem, getattr(owner, "name", None), one.name]
                    yield (".".join(filter(None, place)),
                           " ".join(ast.get_docstring(node) or "" for node in about))


def test_a_docstring_says_that_a_value_is_refused():
    found = dict(functions_that_refuse())
    assert len(found) > 20
    silent = [name for name, said in found.items()
              if "ValueError" not in said and "refused" not in said]
    assert not silent


# --- the book's links -----------------------------------------------------------------

BOOK = sorted((ROOT / "notebooks").glob("*.ipynb"))


def title_of(notebook):
    first = json.loads(notebook.read_text(encoding="utf-8"))["cells"][0]["source"]
    number, title = "".join(first).splitlines()[0].lstrip("# ").split(" · ")
    assert notebook.name.startswith(number)
    return f"{number} {title}"


@pytest.mark.parametrize("notebook", BOOK, ids=lambda path: path.stem)
def test_a_chapter_calls_the_others_by_their_names(notebook):
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    text = "\n".join("".join(cell["source"]) for cell in cells
                     if cell["cell_type"] == "markdown")
    for words, target in re.findall(r"\[([^\]]*)\]\(([^)#]+\.ipynb)\)", text):
        path = notebook.parent / target
        assert path.exists(), target
        if re.match(r"\d\d ", words) and path.parent == notebook.parent:
            assert " ".join(words.split()) == title_of(path)


def words_of(notebook):
    """The text cells of a chapter, each on one line; without the book's last pages."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    text = [" ".join("".join(cell["source"]).split()) for cell in cells
            if cell["cell_type"] == "markdown"]
    return [cell for cell in text if not cell.startswith(("## Sources", "## Index"))]


def last_page(title):
    """The text of one of the book's last pages, at the end of its last chapter."""
    cells = json.loads(BOOK[-1].read_text(encoding="utf-8"))["cells"]
    (page,) = ["".join(cell["source"]) for cell in cells
               if "".join(cell["source"]).startswith(f"## {title}")]
    return page


def test_whoever_is_cited_stands_among_the_sources_at_the_end_of_the_book():
    """A name with a year, as in "Silver et al. 2014", is one line there."""
    text = {path.name: "\n".join(words_of(path)) for path in BOOK} | {
        path.name: path.read_text(encoding="utf-8")
        for path in (ROOT / "dnddpg_minimal").rglob("*.py")}
    cited = [(place, *found) for place, words in text.items() for found in re.findall(
        r"([A-Z][a-zé]+)(?:'s)?(?:\s+[a-zA-Z.,]+){0,5}?\s*[ (,]\s*((?:19|20)\d\d)\b",
        words)]
    cited = [one for one in cited if one[1] != "After"]  # "After 2000 updates"
    assert len(cited) > 30
    sources = last_page("Sources").splitlines()
    missing = [one for one in cited
               if not any(one[1] in line and one[2] in line for line in sources)]
    assert not missing


def test_a_word_in_the_index_stands_in_the_chapters_that_it_names():
    entries = " ".join(last_page("Index").split("\n\n")[-1].split()).split(" · ")
    text = {path.name[:2]: " ".join(words_of(path)).lower() for path in BOOK}
    assert len(entries) > 40 and entries == sorted(entries, key=str.lower)
    for entry in entries:
        word, chapters = re.fullmatch(r"(.+?) (\d\d(?:, \d\d)*)", entry).groups()
        pattern = re.escape(word.lower()) + "s?"
        for chapter in chapters.split(", "):
            assert re.search(rf"\b{pattern}\b", text[chapter]), entry


def test_the_algorithm_is_as_short_as_the_reading_guides_say():
    """README and chapter 00: sections 3 to 6, up to PyTorch's agent: 270 lines."""
    text = (ROOT / "dnddpg_minimal" / "dnddpg.py").read_text(encoding="utf-8")
    code = {number for number, line in enumerate(text.splitlines(), 1)
            if line.strip() and not line.strip().startswith("#")}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                code -= set(range(first.lineno, first.end_lineno + 1))  # docstrings
    begin, end = (text[:text.index(mark)].count("\n")
                  for mark in ("# --- 3.", "class TorchAgent"))
    assert sum(begin < number <= end for number in code) == pytest.approx(270, abs=10)
