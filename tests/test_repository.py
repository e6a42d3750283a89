"""The repository's promises about itself: pinned requirements, README's commands, and a manual in every script."""

import ast
import importlib
import re
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TEST_TOOLS = {"pytest", "hypothesis"}
SCRIPTS = sorted(path.stem for path in ROOT.glob("*.py") if path.read_text().startswith("# /// script"))


def requirements():
    return [line for line in (ROOT / "requirements.txt").read_text().splitlines() if line and not line.startswith("#")]


def blocks(markdown):
    """Fenced blocks of code."""
    return re.findall(r"^```\w*\n(.*?)^```$", markdown, re.DOTALL | re.MULTILINE)


def test_scripts_are_found():
    assert "gpo_ppo" in SCRIPTS and len(list(ROOT.glob("*.py"))) == len(SCRIPTS)


def test_requirements_are_pinned_exactly():
    assert all(re.fullmatch(r"[\w-]+(\[\w+\])?==[\d.]+", line) for line in requirements())


@pytest.mark.parametrize("script", SCRIPTS)
def test_header_equals_requirements_less_the_test_tools(script):
    """What `uv run` installs is what README's commands install."""
    text = (ROOT / f"{script}.py").read_text()
    header = text[: text.index("# ///\n", 10)].removeprefix("# /// script\n")
    header = tomllib.loads("".join(line.removeprefix("#").removeprefix(" ") for line in header.splitlines(keepends=True)))
    expected = [line for line in requirements() if line.split("==")[0] not in TEST_TOOLS]
    assert header == {"requires-python": ">=3.11", "dependencies": expected}


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_import_of_a_script_is_a_requirement(script):
    import sys

    tree = ast.parse((ROOT / f"{script}.py").read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    packages = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names)
    known = {re.match(r"[\w-]+", line)[0] for line in requirements()}
    assert packages <= known | {"gpo_envs"}


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_flag_has_one_line_of_help_in_its_group(script, capsys, monkeypatch):
    module = importlib.import_module(script)
    lines = {}  # (class, flag) -> the text below it
    for node in ast.walk(ast.parse((ROOT / f"{script}.py").read_text())):
        if isinstance(node, ast.ClassDef):
            for flag, text in zip(node.body, node.body[1:]):
                if isinstance(flag, ast.AnnAssign) and isinstance(text, ast.Expr):
                    lines[node.name, flag.target.id] = text.value.value
    monkeypatch.setenv("COLUMNS", "80")  # wide terminals get two columns, which would be hard to read here
    with pytest.raises(SystemExit) as stop:
        module.main(["--help"])
    assert stop.value.code == 0
    boxes, title = {}, None
    for line in capsys.readouterr().out.splitlines():
        heading = re.fullmatch(r"\W*((?:[\w-]+ )?options)\W*", line)  # with a frame around it, or plain
        if heading:
            title = heading[1]
            boxes[title] = ""
        elif title:
            boxes[title] += " " + " ".join(line.strip("│").split())
    assert len(boxes) == 1 + len(fields(module.Args))
    for group in fields(module.Args):
        for flag in fields(group.type):
            text, box = lines[group.type.__name__, flag.name], boxes[group.name.replace("_", "-") + " options"]
            assert text and "\n" not in text and text == text.strip()
            assert f" --{flag.name.replace('_', '-')}" in box and text in box, flag.name


def test_readmes_first_commands_set_everything_up():
    """One command trains, one runs the tests; both make the environment that they need."""
    train, test = (block.strip() for block in blocks((ROOT / "README.md").read_text())[:2])
    for command in (train, test):
        assert "\n" not in command and "-m venv" in command and "install" in command and "-r requirements.txt" in command
    assert test.endswith("-m pytest") and "gpo_ppo.py" in train
    assert "README.md" in (ROOT / ".ci" / "run").read_text()


def test_commands_in_the_documentation_exist(tmp_path):
    """Every command that starts a Python file names one that is there, and flags that it has."""
    found = []
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        text = page.read_text()
        candidates = [line for block in blocks(text) for line in block.replace("\\\n", " ").splitlines()]
        candidates += [
            " ".join(code.split()) for code in re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M))
        ]
        for line in candidates:
            for match in re.finditer(r"(?:python3?|uv run|torchrun[^&|;]*?) ([\w/]+\.py)([^&|;]*)", line):
                found.append((page.name, *match.groups()))
    assert any(name == "README.md" and path == "gpo_ppo.py" for name, path, _ in found)
    for name, path, rest in found:
        assert (ROOT / path).is_file(), f"{name}: {path}"
        if Path(path).stem in SCRIPTS and str(Path(path).parent) == ".":
            module = importlib.import_module(Path(path).stem)
            flags = {flag.name for group in fields(module.Args) for flag in fields(group.type)} | {"help"}
            for word in shlex.split(rest, comments=True):
                if word.startswith("--"):
                    flag = word[2:].split("=")[0].replace("-", "_")
                    assert flag in flags or flag.removeprefix("no_") in flags, f"{name}: {path} {word}"


def test_links_in_the_documentation_exist():
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"
