"""Rules of the house that a machine can check, as a script: ``python tests/style.py`` names what breaks them.

Rules for the packages: who imports whom, kernels that say what they write, and no forms of loops outside of them. The
house is shown in `docs/contribute.md`; `MAY_IMPORT` is its table of arrows. Rules for the tests: they use public
names, and each of them checks something. A rule for words: a sentence points back at most once. ``ruff`` has the other
rules of style.
"""

import ast
import io
import re
import sys
import tokenize
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KERNEL_FILES = sorted((ROOT / "lfpiv_kernels").rglob("*.py"))
PACKAGE_FILES = sorted((ROOT / "lfpiv").rglob("*.py"))
TESTS = ROOT / "tests"
FILES = sorted(TESTS.rglob("*.py"))
TEST_FILES = [path for path in FILES if path.name.startswith("test_")]

GROUND = {
    "geometry",
    "files",
    "errors",
    "hdf5",
    "hdf5_structure",
    "records",
    "warn",
    "version",
    "progress",
    "prompt",
    "quantities",
    "settings",
}
"""Rooms that every room may import, beside `lfpiv_kernels`."""
FACES = {"__init__", "__main__", "derived", "statistics"}
"""Files that hand public names on: they may import every room, and no room imports them."""

MAY_IMPORT = {
    "errors": set(),
    "version": set(),
    "progress": set(),
    "prompt": {"quantities"},
    "quantities": set(),
    "hdf5": {"errors", "records", "hdf5_structure"},
    "hdf5_structure": {"errors"},
    "records": set(),
    "warn": {"records"},
    "files": {"errors", "version"},
    "geometry": set(),
    "settings": {"geometry"},
    "experiment": set(),
    "lightfield": set(),
    "velocity": set(),
    "metrics": set(),
    "calibration": {"lightfield", "experiment"},
    "simulation": {"experiment"},
    "results": {"experiment", "velocity"},
    "weights": {"calibration", "lightfield"},
    "reconstruction": {"weights", "calibration", "lightfield", "velocity"},
    "tracking": {"reconstruction", "weights", "calibration", "metrics", "velocity"},
    "sequence": {"reconstruction", "weights", "velocity"},
    "damping": {"reconstruction", "weights", "calibration", "velocity"},
    "joint": {"sequence", "reconstruction", "weights", "velocity"},
    "selfcalibration": {"reconstruction", "weights", "calibration"},
    "report": {"results", "calibration", "lightfield", "velocity", "experiment", "simulation"},
}
MAY_IMPORT["runs"] = set(MAY_IMPORT) - GROUND - {"metrics", "simulation"}
MAY_IMPORT["planning"] = set(MAY_IMPORT) - GROUND - {"metrics", "simulation"}
MAY_IMPORT["reproduce"] = set(MAY_IMPORT) - GROUND
MAY_IMPORT["benchmark"] = {"simulation", "metrics", "results", "report", "experiment"}
MAY_IMPORT["studio"] = set(MAY_IMPORT) - GROUND | {"lfpiv"}  # it calls what users call
MAY_IMPORT["cli"] = set(MAY_IMPORT) - GROUND
"""What each room of `lfpiv` may import beside itself and `GROUND`. Rooms of the ground import only what stands here."""

PUBLIC_WITH_UNDERSCORE = {"_asdict", "_fields", "_make", "_replace"}
"""Public names of named tuples."""
FOREIGN = {"wp", "ti"}
"""Libraries whose private names tests may use, where there are no public ones."""
SETTERS = {"setattr", "getattr", "delattr", "hasattr"}
"""Functions that take the name of an attribute as a text."""
ATOMICS = ("atomic_add", "atomic_sub", "atomic_max", "atomic_min", "atomic_exch", "atomic_cas", "tile_store")
"""Calls that write to their first argument."""


FOLLOWS = (
    "of or and that which who whose is are was were has have had in on by with for to at from before after behind"
    " beyond as if the a an without beside per than where when but it they so not can may does"
)
"""Words that never follow a number: `one` before them, or at the end of a clause, points back."""
IDIOMS = re.compile(
    r"one (?:after|behind|beside) (?:the )?(?:other|another)|one (?:by|to|or) one|`[^`\n]*`", re.IGNORECASE
)
POINTS_BACK = re.compile(
    rf"\bthat of\b|\bthose of\b|\bones\b|(?<!-)\bone\b(?!-)(?=[^\w\s]|\Z|\s+(?:{FOLLOWS.replace(' ', '|')})\b)",
    re.IGNORECASE,
)
"""Words that stand for a noun of before. A reader looks for the noun; at most one of them is in a sentence."""
SENTENCE_ENDS = re.compile(r"(?<=[.!?])[\"')\]*]*\s+|\n\s*\n|\n\s*(?:[-*]|\d+\.) |\||\n\s*-{3,}\n|\n#+ ")


@cache
def tree_of(path):
    return ast.parse(path.read_text("utf-8"))


def imported(tree, package=""):
    """Full names of the modules a file of a package imports, wherever in the file, relative imports resolved."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def room_of(path):
    """Room of a file of `lfpiv`: its folder, or its own name where it lies beside the folders."""
    return path.relative_to(ROOT / "lfpiv").parts[0].removesuffix(".py")


def rooms_imported(tree, package, rooms):
    """Rooms of `lfpiv` that a file imports; "lfpiv" itself where it imports a public name from the top."""
    for name in imported(tree, package):
        parts = name.split(".")
        if parts[0] == "lfpiv":
            yield parts[1] if len(parts) > 1 and parts[1] in rooms else "lfpiv"


def wrong_arrows(room, tree, package, rooms):
    """Rooms that a file imports and may not. Importing a submodule names "lfpiv" too: that counts only by itself."""
    found = set(rooms_imported(tree, package, rooms))
    if "lfpiv" not in plain_imports(tree) and not any(top_names(tree, rooms)):
        found.discard("lfpiv")
    allowed = MAY_IMPORT[room] | {room} | (GROUND if room not in GROUND else set())
    return sorted(found - allowed)


def plain_imports(tree):
    """Names in `import ...` statements."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def top_names(tree, rooms):
    """Names that `from lfpiv import ...` takes and that are no rooms: public names of the top."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "lfpiv" and node.level == 0:
            yield from (alias.name for alias in node.names if alias.name not in rooms)


def kernels(tree):
    """Functions decorated as kernels."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            names = [ast.unparse(item.func if isinstance(item, ast.Call) else item) for item in node.decorator_list]
            if any(name in ("ti.kernel", "wp.kernel", "native.kernel") for name in names):
                yield node


def root_name(node):
    while isinstance(node, (ast.Subscript, ast.Attribute)):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def written_arguments(kernel):
    """Arguments of a kernel that it writes to: item assignments, atomics and whole tiles."""
    arguments = {argument.arg for argument in kernel.args.args}
    for node in ast.walk(kernel):
        targets = []
        if isinstance(node, ast.Assign):
            targets = [part for target in node.targets for part in getattr(target, "elts", [target])]
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            targets = [node.target]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ATOMICS:
            targets = [node.args[0]]
            if isinstance(targets[0], ast.Name):  # wp.atomic_add(array, index, value)
                yield targets[0].id
        for target in targets:
            if isinstance(target, ast.Subscript) and root_name(target) in arguments:
                yield root_name(target)


def module_of(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def package_of(path):
    return ".".join(path.relative_to(ROOT).parts[:-1])


def is_private(name):
    return name.startswith("_") and not name.endswith("__") and name not in PUBLIC_WITH_UNDERSCORE


def private_names(tree, kernels=False):
    """Yield private names that a file uses of others, and constructors that it bypasses by `__new__`.

    Tests of kernels may import private kernels: these are the units under test.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            of_kernels = kernels and isinstance(node.value, ast.Name)
            if node.attr == "__new__" or (is_private(node.attr) and not of_kernels):
                if ast.unparse(node.value) not in {"self", "cls", "super()"} | FOREIGN:
                    yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and not kernels:
            yield from (f"{node.module}.{alias.name}" for alias in node.names if is_private(alias.name))
        elif isinstance(node, ast.Call) and last_name(node.func) in SETTERS:
            texts = [part.value for part in node.args if isinstance(part, ast.Constant) and isinstance(part.value, str)]
            yield from (text for text in texts if is_private(text.rpartition(".")[2]))


def last_name(called):
    return getattr(called, "attr", getattr(called, "id", ""))


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def checks(function, checking):
    """Whether a function asserts, expects an exception or a warning, or calls one of the functions `checking`."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Call):
            name = last_name(node.func)
            if name in checking or name.startswith("assert_") or name in ("raises", "warns", "fail"):
                return True
    return False


def checking_helpers(trees, known=frozenset()):
    """Names of the functions of some files that check something, themselves or by functions that they call.

    `known` are such names in other files.
    """
    every, found, before = [f for tree in trees for f in functions(tree)], set(known), None
    while found != before:
        before = set(found)
        found |= {f.name for f in every if f.name not in found and checks(f, found)}
    return {name for name in found if not name.startswith("test_")}


# -- the rules: each yields what breaks it -----------------------------------------------------------------------------


def imports():
    """Kernels never import the package above; files import only what the table allows."""
    for path in KERNEL_FILES:
        for name in imported(tree_of(path), package_of(path)):
            if name == "lfpiv" or name.startswith("lfpiv."):
                yield path, f"kernels may not import {name}"
    for path in PACKAGE_FILES:
        if room_of(path) in FACES:
            continue
        if room_of(path) not in MAY_IMPORT:
            yield path, "its room is missing in MAY_IMPORT"
        elif wrong := wrong_arrows(room_of(path), tree_of(path), package_of(path), set(MAY_IMPORT) | FACES):
            yield path, f"may not import {', '.join(wrong)}: see MAY_IMPORT"


def circles():
    """Neither the table nor the modules of both packages form a circle, imports inside functions included."""
    rooms = {
        room: (allowed | (GROUND if room not in GROUND else set())) - {room} for room, allowed in MAY_IMPORT.items()
    }
    paths = {module_of(path): path for path in KERNEL_FILES + PACKAGE_FILES}
    modules = {}
    for module, path in paths.items():
        names = set(imported(tree_of(path), package_of(path))) & set(paths)
        modules[module] = {name for name in names if name != module and paths[name].name != "__init__.py"}
    for left in (rooms, modules):
        while ground := [name for name, others in left.items() if not others & set(left)]:
            for name in ground:
                del left[name]
        if left:
            yield ROOT, f"a circle among {', '.join(sorted(left))}"


def taichi():
    """Files of Taichi kernels have no postponed annotations."""
    for path in KERNEL_FILES + PACKAGE_FILES:
        names = set(imported(tree_of(path)))
        if "taichi" in names and any(kernels(tree_of(path))) and "__future__.annotations" in names:
            yield path, "Taichi rejects postponed annotations"


def kernel_arguments():
    """Kernels are private, have no defaults, and write only arguments that are named so."""
    for path in KERNEL_FILES:
        source = path.read_text("utf-8")
        for kernel in kernels(tree_of(path)):
            if not kernel.name.startswith("_"):
                yield path, f"{kernel.name} is public: give it a host function"
            if kernel.args.defaults:
                yield path, f"{kernel.name} has default arguments"
            header = "\n".join(source.splitlines()[kernel.lineno - 1 : kernel.body[0].lineno])
            if not ("# in" in header and "# out" in header):
                yield path, f"{kernel.name} lacks its in or out section"
            if wrong := [name for name in written_arguments(kernel) if not name.endswith("_out")]:
                yield path, f"{kernel.name} writes {wrong}, whose names do not end in _out"


def loops():
    """Only kernels' host functions ask for the form of the loops."""
    for path in PACKAGE_FILES:
        if "device().form" in path.read_text("utf-8"):
            yield path, "asks for device().form: let a host function of lfpiv_kernels answer"


def tests():
    """Tests use public names, and each of them checks something."""
    support = checking_helpers([tree_of(path) for path in FILES if path not in TEST_FILES])
    for path in FILES:
        if found := list(private_names(tree_of(path), kernels=path.parent.name == "kernels")):
            yield path, f"uses {', '.join(found)}: test through public names, or make these public"
    for path in TEST_FILES:
        checking = checking_helpers([tree_of(path)], support)
        for function in functions(tree_of(path)):
            if function.name.startswith("test_") and not checks(function, checking):
                yield path, f"{function.name} checks nothing"


def sentences():
    """A sentence of a docstring, a comment, a message or a page points back at most once."""
    python = (*KERNEL_FILES, *PACKAGE_FILES, *(ROOT / "perf").rglob("*.py"), *FILES)
    pages = (
        ROOT / "README.md",
        ROOT / "CHANGELOG.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs/notebook").glob("*.md"),
    )
    for texts, paths in ((python_texts, python), (page_texts, pages)):
        for path in paths:
            for text in dict.fromkeys(texts(path)):
                for sentence in SENTENCE_ENDS.split(text):
                    if len(found := POINTS_BACK.findall(IDIOMS.sub("", sentence))) > 1:
                        yield path, f"points back {len(found)} times ({', '.join(found)}): {' '.join(sentence.split())}"


def python_texts(path):
    """Yield what people read in a file of Python: docstrings, messages, and comments as they stand together."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "X" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "\n" not in node.value:
            yield node.value
    block, last = [], 0
    for token in tokenize.generate_tokens(io.StringIO(path.read_text("utf-8")).readline):
        if token.type == tokenize.COMMENT:
            alone = not token.line[: token.start[1]].strip()
            if block and not (alone and token.start[0] == last + 1):
                yield "\n".join(block)
                block = []
            block.append(token.string.lstrip("#! "))
            last = token.start[0]
    yield "\n".join(block)


def page_texts(path):
    """Yield the prose of a page, without code and equations."""
    yield re.sub(r"^```.*?^```\s*$|\$\$.*?\$\$", "\n\n", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)


RULES = (imports, circles, taichi, kernel_arguments, loops, tests, sentences)


def broken():
    """What breaks the rules, a line each."""
    return [f"{path.relative_to(ROOT)}: {what}" for rule in RULES for path, what in rule()]


if __name__ == "__main__":
    sys.exit("\n".join(broken()) or 0)
