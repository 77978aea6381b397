"""The rooms of the architecture and who may enter them: imports go one way, and heavy packages come in on demand."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from khop_env.catalog import ENVIRONMENTS

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("khop_env", "agents", "benchmarks")
ON_DEMAND = ("khop_env.commands.bench", "benchmarks.benchmark")  # the one that runs what only a clone has

# One line a rank; nothing imports from a later line. A new module has to be put in its place here.
RANKS = [
    [
        "khop_env.compiled",
        "khop_env.catalog",
        "khop_env.brief",
        "khop_env.collection",
        "khop_env.extras",
        "khop_env.own_agents",
        "khop_env.objects",
        "khop_env.threads",
    ],
    ["khop_env.elementary"],
    ["khop_env.physics"],
    ["khop_env.network"],
    ["khop_env.observers"],
    ["khop_env.simulation"],
    ["khop_env.tasks"],
    ["khop_env.env"],
    ["khop_env.scenarios"],
    ["khop_env.registry", *(f"khop_env.{name}" for name in ENVIRONMENTS)],
    ["khop_env.typed"],
    ["khop_env.testing"],
    ["khop_env.results"],
    ["khop_env.deploy"],
    ["agents"],
    ["khop_env.terminal"],
    ["khop_env.commands"],
    ["khop_env.cli", "khop_env.__main__"],
    ["benchmarks"],  # not in the wheel, so that nothing may need it
]
# Where a third-party package may be imported at all (architecture, last paragraph of the import order).
HEAVY = {
    "torch": ("agents", "benchmarks.peers", "benchmarks.training"),  # the peers run in environments of their own
    "ray": ("agents",),
    "sb3_contrib": ("agents.learning.recurrent",),
    "stable_baselines3": ("agents", "khop_env.env.sb3", "khop_env.testing.libraries", "benchmarks.peers"),
    "matplotlib": ("khop_env.results", "khop_env.env.rendering", "benchmarks.side_by_side", "benchmarks.precision"),
    "pygame": ("khop_env.env.rendering",),
    "imageio_ffmpeg": ("khop_env.results",),
}
NOT_ON_IMPORT = {
    *("matplotlib", "pygame", "torch", "ray", "stable_baselines3", "polars", "pandas", "rich", "typer", "tomlkit"),
    *("scipy", "numba", "sb3_contrib"),
}
STEPPING = (
    "from khop_env import consensus_v0; env = consensus_v0.parallel_env(); env.reset(seed=0); "
    "env.step({agent: env.action_space(agent).sample() for agent in env.agents})"
)


def modules() -> dict[str, Path]:
    """All modules by name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def rank(module: str) -> int:
    """The line of RANKS that a module belongs to."""
    for number, names in enumerate(RANKS):
        if any(module == name or module.startswith(name + ".") for name in names):
            return number
    raise LookupError(f"{module} has no place in the architecture: add it to RANKS in tests/test_imports.py")


def imports(module: str) -> list[tuple[int, str]]:
    """(line, imported module) of every import statement in a module, in functions and under TYPE_CHECKING too.

    What is read as an attribute of `khop_env` itself counts as an import, since the package fetches it on demand.
    """
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names if alias.name != "khop_env"]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "khop_env":
            found.append((node.lineno, f"khop_env.{node.attr}"))
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parent = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parent, *([node.module] if node.module else [])])
            for alias in node.names:  # `from package import module` imports the module
                whole = f"{base}.{alias.name}"
                found.append((node.lineno, whole if whole in MODULES or base == "khop_env" else base))
    return found


@pytest.mark.parametrize("module", [name for name in MODULES if name != "khop_env"])
def test_nothing_imports_to_its_right(module: str) -> None:
    """The order of RANKS: physics < network < observers < simulation < ... < agents < cli < benchmarks."""
    wrong = [
        f"line {line}: {module} imports {other}"
        for line, other in imports(module)
        if other.split(".")[0] in PACKAGES
        and other != "khop_env.__version__"
        and (module, other) != ON_DEMAND
        and rank(other) > rank(module)
    ]
    assert not wrong, wrong


@pytest.mark.parametrize("module", MODULES)
def test_heavy_packages_are_imported_in_their_rooms_only(module: str) -> None:
    """torch, ray in agents; stable_baselines3 there, in env/sb3.py and for its own check; matplotlib where it draws."""
    for line, other in imports(module):
        rooms = HEAVY.get(other.split(".")[0], (module,))
        assert any(module == room or module.startswith(room + ".") for room in rooms), f"line {line} imports {other}"


def test_ranks_name_existing_rooms_in_the_architecture_s_order() -> None:
    """The list above is the one of architecture.md: a typing error in it would make the test pass for nothing."""
    names = [name for names in RANKS for name in names]
    assert len(set(names)) == len(names)
    for name in MODULES:
        assert name == "khop_env" or rank(name) >= 0
    assert rank("khop_env.physics.graph") < rank("khop_env.network") < rank("khop_env.observers")
    assert rank("khop_env.observers") < rank("khop_env.simulation.plant")
    assert rank("khop_env.scenarios.paper") < rank("agents.laws") < rank("khop_env.cli")


def test_only_one_command_runs_the_benchmarks_and_on_demand() -> None:
    """The wheel is without them: every module of it can be imported there."""
    module, other = ON_DEMAND
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == other]
    assert nodes
    assert not set(nodes) & set(tree.body)
    assert "benchmarks" not in loaded_by("import khop_env.cli")


def loaded_by(statement: str) -> list[str]:
    """Top-level packages in sys.modules after a statement in a fresh interpreter."""
    code = f"import sys; {statement}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_import_khop_env_is_light() -> None:
    """No plotting, learning, table or compiling package, so that `import khop_env` is quick and works without them."""
    loaded = loaded_by("import khop_env; khop_env.__version__")
    assert "khop_env" in loaded
    assert not NOT_ON_IMPORT & set(loaded)


@pytest.mark.parametrize("arguments", [["list"], ["run", "--help"]])
def test_khop_list_and_help_import_little(arguments: list[str]) -> None:
    """They answer without scenarios, environments, graphs and compiled code."""
    code = (
        f"import sys; sys.argv[1:] = {arguments}\nfrom khop_env.cli import main\n"
        "try: main()\nexcept SystemExit: print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "khop_env.commands.scenarios" in loaded
    assert not {"networkx", "numba"} & loaded
    library = range(rank("khop_env.elementary"), rank("agents") + 1)
    assert not [name for name in loaded if name in MODULES and name != "khop_env" and rank(name) in library]


@pytest.mark.parametrize(
    "statement",
    [
        "import khop_env.scenarios",
        "import agents, agents.learning",
        "import khop_env.simulation, khop_env.observers",
        STEPPING,
    ],
)
def test_the_core_needs_no_extra(statement: str) -> None:
    """Running scenarios and environments needs NumPy, networkx, Gymnasium and Numba; others wait until they are used.

    Numba imports SciPy where it is installed.
    """
    assert not (NOT_ON_IMPORT - {"numba", "scipy"}) & set(loaded_by(statement))
