"""Documentation that cannot rot: its Python runs, its commands are understood, its keys are described, its links lead
somewhere. The gallery's scripts run when the pages are built."""

import ast
import doctest
import importlib
import importlib.resources
import importlib.util
import itertools
import json
import logging
import re
import runpy
import shlex
import shutil
import sys
import typing
from pathlib import Path

import matplotlib
import pytest
from pydantic import BaseModel
from support.public_names import public_modules
from support.small_run import leave_out

import lfpiv
from lfpiv.cli import commands
from lfpiv.experiment.toml import tomllib
from lfpiv.runs import pipeline
from lfpiv.settings.experiment import ExperimentTable
from lfpiv.simulation.scene import Scene, open_scene
from lfpiv.warn import Code

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
FILES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted((DOCS / "notebook").glob("*.md")))
PAGES = {page.relative_to(ROOT).as_posix(): page for page in FILES}
TEXTS = {name: page.read_text("utf-8") for name, page in PAGES.items()}
NOTEBOOK = {name: page for name, page in PAGES.items() if name.startswith("docs/notebook/")}
SCRIPTS = sorted((DOCS / "gallery").glob("plot_*.py"))
SOURCES = {
    package: {path.relative_to(ROOT): path.read_text("utf-8") for path in sorted((ROOT / package).rglob("*.py"))}
    for package in ("lfpiv", "lfpiv_kernels")
}
MODULES = {
    ".".join(path.with_suffix("").parts).removesuffix(".__init__"): text
    for package in SOURCES.values()
    for path, text in package.items()
}
"""Source of each module by its dotted name."""

ENDINGS = ("py", "md", "h", "toml", "h5", "json", "html", "nc", "pvd", "jsonl", "zarr", "cih")
"""Endings of file names, which look like attributes of modules."""

LONG = ("benchmark", "demo", "init", "reproduce", "simulate", "studio")
"""Commands that take long, ask or serve a page: checked to be understood, not run. Each has tests of its own."""


def blocks(page):
    """Language, text and line of each fenced block of a page."""
    text = page.read_text("utf-8")
    for match in re.finditer(r"^```([^\n]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield match[1].strip(), match[2], text.count("\n", 0, match.start()) + 2


def commands_of(page):
    """Commands of this package in the shell blocks of a page, as lists of words."""
    for language, text, _ in blocks(page):
        if language in ("", "sh", "bash"):
            for line in re.split(r"\n|&&", text):
                words = shlex.split(line, comments=True)
                if words[:1] == ["lfpiv"]:
                    yield words[1:]


@pytest.fixture(scope="module")
def place(small_run, tmp_path_factory):
    """Folder as a reader has it: the demonstration's, finished, and an experiment of one's own beside it."""
    folder = tmp_path_factory.mktemp("docs") / "place"
    small_run.results(folder / "lfpiv-demo")
    experiment = small_run.images(folder / "lfpiv-demo" / "experiment")
    text = experiment.read_text("utf-8")
    experiment.write_text(text.replace("[12, 12, 12]", "[6, 8, 8]"), "utf-8")  # gradients need three vectors along z
    with pytest.MonkeyPatch.context() as patch:
        leave_out(patch.setattr)
        pipeline.correlate(experiment, folder / "lfpiv-demo")
    shutil.copytree(folder / "lfpiv-demo", folder / "results", ignore=shutil.ignore_patterns("experiment"))
    shutil.copytree(experiment.parent, folder, dirs_exist_ok=True)
    return folder


@pytest.fixture
def reader(place, brief_run, monkeypatch):
    """A process in that folder; what a snippet does to plots and logging is undone."""
    monkeypatch.chdir(place)
    backend, handlers, level = matplotlib.get_backend(), logging.root.handlers[:], logging.root.level
    matplotlib.use("agg")
    yield place
    import matplotlib.pyplot as plt

    plt.close("all")
    matplotlib.use(backend)
    logging.root.handlers[:] = handlers
    logging.root.setLevel(level)


WITH_PYTHON = [name for name, page in PAGES.items() if any(language == "python" for language, _, _ in blocks(page))]
WITH_PYTHON.remove("README.md")  # `tests/runs/test_measurement.py` runs its script
TRIED = []  # commands of earlier pages


@pytest.mark.slow
@pytest.mark.parametrize("name", WITH_PYTHON)
def test_the_python_of_a_page_runs_from_top_to_bottom(reader, name):
    module = type(sys)("snippets")  # dataclasses look their module up
    sys.modules["snippets"] = module
    snippets = [(text, line) for language, text, line in blocks(PAGES[name]) if language == "python"]
    assert snippets
    try:
        for text, line in snippets:
            exec(compile("\n" * (line - 1) + text, name, "exec", dont_inherit=True), module.__dict__)
    finally:
        del sys.modules["snippets"]


def command_in(words, known):
    """Name of the command in the words of a line, with that of its group, and the words after it."""
    names = 2 if " ".join(words[:2]) in known else 1
    return " ".join(words[:names]), words[names:]


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, page in PAGES.items() if any(commands_of(page))])
def test_commands_are_understood_and_quick_ones_succeed(reader, tables, name, capfd):
    known = tables.commands()
    for words in commands_of(PAGES[name]):
        command, rest = command_in(words, known)
        if command in known:
            known[command].make_context(command, list(rest))  # raises on what it does not understand
        run = words[0].startswith("-") or (words[0] not in LONG and not {"--workers", "--scheduler"} & set(words))
        assert not run or words in TRIED or commands.call(words) == 0, (words, capfd.readouterr().err)
        TRIED.append(words)


def test_named_commands_and_options_exist(tables):
    known = tables.commands()
    groups = {command.split()[0] for command in known if " " in command}
    spoken_of = {(name, one) for name, text in TEXTS.items() for one in re.findall(r"`lfpiv ([a-z][^`]*)`", text)}
    for name, spoken in sorted(spoken_of):
        if spoken in groups:
            continue
        command, rest = command_in(spoken.split(), known)
        assert command in known, (name, spoken)
        options = {option for parameter in known[command].params for option in parameter.opts} | {"--help"}
        assert {word for word in rest if word.startswith("--")} <= options, (name, spoken)


ALTERNATIVES = {"nominal_direction", "instants", "first", "step"}
"""Keys that stand in place of another one, so that no file has both; the page shows them elsewhere."""


def uncommented(text):
    """An example with its optional keys, `# key = value`, and tables, `# [[table]]`, in force."""
    return re.sub(r"^# (\w+ = |\[\[)", r"\1", text, flags=re.MULTILINE)


def test_experiment_files_are_valid_with_their_optional_keys():
    for language, text, _ in (block for page in FILES for block in blocks(page)):
        if language != "toml":
            continue
        for version in (text, uncommented(text)):
            table = tomllib.loads(version)
            assert table
            if "camera" in table:
                ExperimentTable.model_validate(table)
            else:  # a part of a file: some tables
                for key, values in table.items():
                    ExperimentTable.model_fields[key].annotation.model_validate(values)


def test_the_annotated_experiment_shows_every_key_and_its_default():
    text = next(text for language, text, _ in blocks(PAGES["docs/experiment.md"]) if language == "toml")
    shown = ExperimentTable.model_validate(tomllib.loads(uncommented(text)))
    for path, model in models(ExperimentTable):
        part = shown
        for depth, key in enumerate(path, start=1):
            part = getattr(part, key)
            if isinstance(part, tuple):  # one table of each kind, or the first of those that hold the table sought
                part = next(one for one in part if depth < len(path) or isinstance(one, model))
        assert part.model_fields_set | ALTERNATIVES >= set(type(part).model_fields), path
        elsewhere = set(type(part).model_fields) & ALTERNATIVES
        assert all(re.search(rf"\b{key} = ", PAGES["docs/experiment.md"].read_text("utf-8")) for key in elsewhere), path
        for key, field in model.model_fields.items():
            if not field.is_required() and field.default not in (None, ()) and not isinstance(field.default, BaseModel):
                assert getattr(part, key) == field.default, (path, key)


def models(model, path=()):
    """All tables of a file: where they are and their models."""
    yield path, model
    for key, field in model.model_fields.items():
        for part in parts(field.annotation):
            yield from models(part, (*path, key))


def parts(annotation):
    """Models inside an annotation such as ``tuple[CameraTable, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from parts(argument)


@pytest.fixture(scope="module")
def tables():
    """The module that makes the tables of the pages."""
    return extension("tables")


def extension(name):
    """A module of the pages' builder."""
    if str(DOCS / "_ext") not in sys.path:
        sys.path.append(str(DOCS / "_ext"))
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / "_ext" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def quoted():
    """The module that compares the tutorial with the demonstration, which the build of the pages runs."""
    return extension("quoted")


def test_the_tutorial_quotes_the_demonstration(quoted):
    """The run itself is compared when the pages are built; here the scene is, and that no figure escapes."""
    text = quoted.TUTORIAL.read_text("utf-8")
    with importlib.resources.as_file(importlib.resources.files("lfpiv.cli") / "demo_scene.toml") as path:
        scene = open_scene(path)
    said = quoted.quotes(text)
    assert quoted.of_scene(scene).items() <= said.items()
    assert quoted.unknown_numbers(text) == ["0.04"]  # the published one
    good = {
        "calibration": {
            name: {"dots_found": 245, "sigma_nor_test": sigma}
            for name, sigma in zip(("left", "right"), said["sigma"], strict=True)
        },
        "demo": {"mean_error_voxel": said["error"][0], "largest_displacement_voxel": said["moved"][0]},
        "valid_fraction": said["valid"][0] / 100,
    }
    assert quoted.differences(text, scene, good) == []
    for changed in (
        {"demo": good["demo"] | {"mean_error_voxel": 2 * said["error"][0]}},
        {"demo": good["demo"] | {"mean_error_voxel": float("nan")}},
        {"valid_fraction": 0.9},
        {"calibration": good["calibration"] | {"left": {"dots_found": 244, "sigma_nor_test": 0.0004}}},
        {"calibration": good["calibration"] | {"left": {"dots_found": 245, "sigma_nor_test": 0.005}}},
    ):
        assert len(quoted.differences(text, scene, good | changed)) == 1, changed
    assert quoted.as_built(text, good) == text
    other = good | {"valid_fraction": 0.988, "demo": {"mean_error_voxel": 0.151, "largest_displacement_voxel": 2.58}}
    built = quoted.quotes(quoted.as_built(text, other))
    assert built == said | {"valid": (99.0,), "error": (0.15,), "moved": (2.6,)}
    assert quoted.differences(text, scene, other) == []  # another machine


@pytest.mark.parametrize("file", [ExperimentTable, Scene])
def test_every_key_is_described(tables, file):
    page = PAGES["docs/settings.md"].read_text("utf-8")
    shown = {tables.find(name) for name in re.findall(r"^<!-- keys (\S+) -->", page, re.MULTILINE)}
    for path, model in models(file):
        assert model in shown, f"{'.'.join(path)}: no table of {model.__name__} in docs/settings.md"
        undescribed = [key for key, _, _, meaning in tables.key_rows(model) if not meaning and key != "kind"]
        assert not undescribed, f"{model.__name__}: {undescribed} without a text below them"


def test_every_command_has_its_help_in_the_pages(tables):
    page = PAGES["docs/cli.md"].read_text("utf-8")
    assert set(re.findall(r"^<!-- command (.+) -->$", page, re.MULTILINE)) == set(tables.commands())
    for name in tables.commands():
        assert tables.help_text(name).startswith(f"Usage: lfpiv {name}")


@pytest.mark.parametrize("page", ["settings", "cli"])
def test_tables_in_the_pages_are_those_of_the_code(page):
    """If not: ``python docs/_ext/written_tables.py``. Versions of the parser break lines of its help elsewhere."""
    text = PAGES[f"docs/{page}.md"].read_text("utf-8")
    assert extension("written_tables").written(text).split() == text.split()


def test_every_extra_is_explained():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    section = PAGES["docs/install.md"].read_text("utf-8").partition("## Extras")[2].partition("\n## ")[0]
    assert set(extras) <= set(re.findall(r"^\| `([\w-]+)`", section, re.MULTILINE))


def test_the_conda_recipe_requires_what_the_package_requires():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}  # by conda-forge
    parts = [re.match(r"([\w-]+)(.*?)(;.*)?$", text) for text in project["dependencies"]]
    required = {f"{named.get(part[1], part[1])} {part[2]}" for part in parts} | {f"python {project['requires-python']}"}
    recipe = (ROOT / "recipe" / "meta.yaml").read_text("utf-8")
    listed = recipe.partition("  run:\n")[2].partition("\n\n")[0]
    assert {line.strip(" -") for line in listed.splitlines()} == required
    assert f'version = "{lfpiv.__version__}"' in recipe


def test_every_public_name_has_its_reference():
    pages = "".join(page.read_text("utf-8") for page in PAGES.values())
    listed = re.findall(r"^\.\. auto(?:function|class|exception|module):: (\S+)", pages, re.MULTILINE)
    assert set(lfpiv.__all__) <= set(listed)
    assert {f"lfpiv.{name}" for name in public_modules()} <= set(listed)


def slugs(page):
    """Anchors of a page's headings, as GitHub and the pages' builder make them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads} | set(
        re.findall(r"^\((\S+)\)=$", text, re.MULTILINE)
    )


def links(text):
    """Targets of a page's links, and of its lists of pages."""
    entries = re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    yield from (f"{line}.md" for entry in entries for line in entry.split("\n") if line and not line.startswith(":"))
    yield from re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", text))


def test_links_lead_somewhere():
    made = {f"generated/gallery/images/sphx_glr_{script.stem}" for script in SCRIPTS} | {"generated/gallery/index"}
    for page, target in [(one, target) for one in FILES for target in links(one.read_text("utf-8"))]:
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        if file.startswith("generated/"):
            assert re.sub(r"(_\d{3}\.png|\.rst|\.md)$", "", file) in made, (page, target)
            continue
        path = page.parent / file if file else page
        assert path.exists() or any(path.parent.glob(path.name)), (page, target)
        assert not anchor or anchor in slugs(path), (page, target)


def test_the_report_of_the_demonstration_lies_beside_the_start_page(tmp_path, monkeypatch):
    builder, settings = extension("demonstration"), runpy.run_path(str(DOCS / "conf.py"))
    assert [DOCS / folder for folder in settings["html_extra_path"]] == [builder.EXTRA]
    monkeypatch.setattr(builder, "DEMO", tmp_path)
    monkeypatch.setattr(builder, "EXTRA", tmp_path / "pages")
    monkeypatch.setattr(builder, "compare_with_the_tutorial", lambda: None)  # needs a run; the build itself compares
    builder.EXTRA.mkdir()
    (tmp_path / "report.html").write_text("a report")
    builder.prepare(None)
    named = re.findall(r'<a href="([^"]+)"', (DOCS / "index.md").read_text("utf-8"))
    assert named and {(builder.EXTRA / name).read_text("utf-8") for name in named} == {"a report"}


def test_scripts_use_names_that_exist():
    for script in SCRIPTS:
        for node in ast.walk(ast.parse(script.read_text("utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lfpiv":
                assert hasattr(lfpiv, node.attr), f"{script.name}: lfpiv.{node.attr}"


def prose(text):
    """Text of a page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def resolves(name):
    """Whether a dotted name is a module or an attribute of one; fields without a default count."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        if ".".join(parts[:length]) in MODULES:
            break
    else:
        return False
    found = importlib.import_module(".".join(parts[:length]))
    for part in parts[length:]:
        fields = {**getattr(found, "model_fields", {}), **getattr(found, "__dataclass_fields__", {})}
        if not hasattr(found, part):
            return part in fields
        found = getattr(found, part)
    return True


def docstrings(text):
    """Docstrings of a module, its classes and functions, and the texts below its constants."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


def test_dotted_names_in_pages_and_docstrings_exist():
    texts = {str(page): page.read_text("utf-8") for page in (*PAGES.values(), *SCRIPTS)}
    texts |= {name: "\n".join(docstrings(text)) for name, text in MODULES.items()}
    wrong = [
        f"{place}: {name}"
        for place, text in texts.items()
        for name in re.findall(r"`[~!]?(lfpiv(?:_kernels)?(?:\.\w+)+)[`(]", text)
        if not resolves(name)
    ]
    assert not wrong


def test_names_of_modules_and_their_constants_exist():
    """`module.name` in short, and the constants in the notebook, which says why they have their values."""
    texts = {name: prose(page.read_text("utf-8")) for name, page in PAGES.items()}
    texts |= {name: "\n".join(docstrings(text)) for name, text in MODULES.items()}
    keys = {
        ".".join((*path[-1:], key))
        for file in (ExperimentTable, Scene)
        for path, model in models(file)
        for key in model.model_fields
    }
    others = (*(ROOT / "lfpiv_kernels" / "native").glob("*.h"), *(ROOT / "tests").rglob("test_*.py"))
    everything = (*MODULES.values(), *(path.read_text("utf-8") for path in others))
    words = {word for source in everything for word in re.findall(r"\w+", source)}
    wrong = []
    for place, text in texts.items():
        for short, rest in re.findall(r"`([a-z_]+)\.(\w+)`", text):
            same = [name for name in MODULES if name.rpartition(".")[2] == short and "." in name]
            if same and f"{short}.{rest}" not in keys and rest not in ENDINGS:
                if not any(resolves(f"{name}.{rest}") for name in same):
                    wrong.append(f"{place}: {short}.{rest}")
        if place in NOTEBOOK:
            for constant in re.findall(r"`(_?[A-Z][A-Z_0-9]{2,})`", text):
                if constant not in words:
                    wrong.append(f"{place}: {constant}")
    assert not wrong


def test_named_source_files_exist():
    """Paths start at the root or, in short, inside `lfpiv`; a bare name lies beside the path before it in the text."""
    folders = (ROOT, ROOT / "lfpiv", DOCS)
    parts = ((name, part) for name, text in TEXTS.items() for part in re.split(r"\n\n|\n(?=\|)", prose(text)))
    for name, part in parts:
        for path in re.findall(r"`([\w./]+\.(?:py|h)|(?:lfpiv\w*|tests|perf|docs)/[\w/]*)`", part):
            found = [folder / path for folder in folders if (folder / path).exists()]
            assert found, (name, path)
            folders = (*folders[:3], found[0] if found[0].is_dir() else found[0].parent)
        folders = folders[:3]


@pytest.mark.slow
def test_the_picture_of_the_house_shows_every_package_below_those_that_import_it():
    house = extension("house")
    place = {
        room: (float(x), float(y), float(width))
        for room, x, y, width in re.findall(r'class="room-(\w+)"><rect x="(\S+)" y="(\S+)" width="(\S+)"', house.svg())
    }
    packages = {path.parent.name for path in (ROOT / "lfpiv").glob("*/__init__.py")}
    assert packages - set(house.GROUND) < set(place)
    assert set(place) == set(house.rooms())
    assert all(place[room][1] < place[other][1] for room, others in house.arrows().items() for other in others)
    for (x, y, _), (other_x, other_y, width) in itertools.permutations(place.values(), 2):
        assert y != other_y or x < other_x or x > other_x + width


def test_plots_of_particle_tracking_show_every_figure():
    limits = extension("tracking_limits")
    stored = json.loads(limits.FIGURES.read_text("utf-8"))
    shown = {(row["condition"], row["cameras"]) for row in stored["rows"]}
    assert {condition for condition, _ in shown} <= limits.LINES.keys()
    assert {cameras for _, cameras in shown} <= limits.NAMES.keys()
    drawn = limits.panels(stored)
    assert drawn.count("<svg") == len(limits.SHOWN) and not re.search(r"\bnan\b", drawn)
    assert not set(re.findall(r"#[0-9a-f]{6}", drawn))  # colours are the page's


def test_plots_of_methods_side_by_side_show_every_stored_method():
    side_by_side = extension("side_by_side")
    stored = json.loads(side_by_side.FIGURES.read_text("utf-8"))
    shown = {(row["way"], row["cameras"]) for row in stored["seeding"]}
    assert shown == side_by_side.STYLES.keys()
    drawn = side_by_side.panels(stored)
    assert drawn.count("<svg") == 4 and not re.search(r"\bnan\b", drawn)
    assert all(name in drawn for name, _, _ in side_by_side.STYLES.values())
    assert not set(re.findall(r"#[0-9a-f]{6}", drawn))  # colours are the page's
    for row in stored["seeding"]:
        if row["ppm"] == side_by_side.TABLE_PPM:
            assert f"<td>{row['figures']['error'][0]:.3f}" in side_by_side.table(stored)


def test_plots_of_the_accuracy_show_every_stored_part():
    accuracy_plots = extension("accuracy_plots")
    stored = accuracy_plots.stored_figures()
    shared = {"seeding", "quality", "response-depth"}  # parts of "methods" and "response"
    assert set(stored) == {*accuracy_plots.PLOTS, "seeds", "flows", "methods"} - shared
    for name in accuracy_plots.PLOTS:
        drawn = accuracy_plots.draw(name, stored)
        assert drawn.startswith("<svg") and not re.search(r"\bnan\b", drawn), name
        assert not set(re.findall(r"#[0-9a-f]{6}", drawn))  # colours are the page's
    assert accuracy_plots.lens_table().startswith("| lens |")


def test_plots_of_the_performance_show_every_stored_case():
    performance_plots = extension("performance_plots")
    rows = performance_plots.peer_rows()
    assert {row["case"] for row in rows} == set(performance_plots.PEER_NAMES)
    assert performance_plots.table().count("\n") == len(performance_plots.scaling_rows()) + 1
    for name in performance_plots.PLOTS:
        drawn = performance_plots.draw(name)
        assert drawn.startswith("<svg") and not set(re.findall(r"#[0-9a-f]{6}", drawn)), name


def test_the_page_of_the_benchmark_shows_every_stored_row_and_figure():
    page = extension("benchmark_page")
    rows = page.stored_rows()
    assert {row["method"] for row in rows} <= page.STYLES.keys()
    table = page.rows_markdown(rows)
    assert table.count("\n") == len(rows) + 1 and all(
        f"{row['figures']['error']['value']:.3f}" in table for row in rows
    )
    drawn = page.panels(rows)
    assert drawn.count("<svg") == 1 + len({row["case"] for row in rows}) and not re.search(r"\bnan\b", drawn)
    assert not set(re.findall(r"#[0-9a-f]{6}", drawn))  # colours are the page's
    assert page.cases_markdown().count("\n| `") == len(page.case_rows())
    listed = page.figures_markdown()
    assert all(figure.text in listed for figure in page.figures.all_figures())


def test_pages_show_every_drawing():
    drawings = extension("drawings")
    pages = "".join(page.read_text("utf-8") for page in PAGES.values())
    shown = [name for line in re.findall(r"^```\{drawing\} (.+)$", pages, re.MULTILINE) for name in line.split()]
    assert sorted(shown) == sorted(drawings.DRAWINGS)
    for name in shown:
        drawn = drawings.draw(name)
        assert drawn.startswith("<svg") and not set(re.findall(r"#[0-9a-f]{6}", drawn)), name


def test_the_page_on_troubles_lists_every_warning(tables):
    assert "```{warning-list}" in PAGES["docs/troubleshooting.md"].read_text("utf-8")
    rows = dict(tables.warning_rows())
    assert len(rows) == len(Code) - 1 and all("{" not in sentence for sentence in rows.values())


def test_sections_of_the_method_name_modules_that_exist():
    heads = re.findall(r"^## .*\((.+)\)$", PAGES["docs/method.md"].read_text("utf-8"), re.MULTILINE)
    named = [name.replace("/", ".") for head in heads for name in re.findall(r"`([^`]+)`", head)]
    assert named
    assert [name for name in named if not {f"lfpiv.{name}", f"lfpiv_kernels.{name}"} & set(MODULES)] == []


def test_each_page_of_the_notebook_has_one_title_of_one_form():
    for name, page in NOTEBOOK.items():
        titles = re.findall(r"^# (.+)$", prose(page.read_text("utf-8")), re.MULTILINE)
        assert len(titles) == 1, name
        assert titles == ["Notebook"] if name == "docs/notebook/index.md" else titles[0].startswith("Notebook: "), name


def with_examples():
    """Modules whose docstrings hold examples."""
    return (name for name, text in MODULES.items() if ">>> " in text)


@pytest.mark.parametrize("name", [*with_examples()])
def test_examples_in_docstrings(name, reader):
    failed, tried = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert tried and not failed
