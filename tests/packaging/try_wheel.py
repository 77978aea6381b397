"""Install the wheel on the oldest and the newest supported Python found, without extras, and use it as a user would.

Usage: try_wheel.py FOLDER, where FOLDER has one wheel and one source distribution, as `make wheel` makes them.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("khop_env", "agents")
IN_THE_SOURCE = ("README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile", "constraints.txt", "tests", "docs")
COMMANDS = (
    "list",
    "check paper",
    "run paper --duration 0.2",
    "evaluate consensus_v0 --policies tanh,ppo:pretrained --observe estimate --episodes 2",
)
CODE = """
import importlib.util
from importlib.resources import files
import gymnasium
import khop_env
from agents.learning import PRETRAINED, LearnedPolicy
for name in ("benchmarks", "tests", "torch", "stable_baselines3"):
    assert importlib.util.find_spec(name) is None, name
for name in ("khop_env", "agents"):
    assert (files(name) / "py.typed").is_file(), name
assert (files("agents") / "tuned.toml").is_file()
for path in PRETRAINED.glob("*.npz"):
    print(path.stem, LearnedPolicy.load(path).environment)
for name in khop_env.environments():
    env = khop_env.make(name)
    env.reset(seed=0)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
env = gymnasium.make("khop/Consensus-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
"""


def python_of(version: str) -> str | None:
    """A Python of this version that can make environments: on the PATH, or one of pyenv's."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    places = [shutil.which(f"python{version}"), *sorted(pyenv.glob(f"{version}.*/bin/python")), sys.executable]
    code = "import sys, ensurepip; print('%d.%d' % sys.version_info[:2])"
    for place in filter(None, places):
        done = subprocess.run([place, "-c", code], capture_output=True, text=True)
        if done.returncode == 0 and done.stdout.strip() == version:
            return str(place)
    return None


def supported() -> list[str]:
    """The Pythons that pyproject.toml names, oldest first."""
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    named = [line.rpartition(" ")[2] for line in classifiers if line.startswith("Programming Language :: Python :: 3.")]
    return sorted(named, key=lambda version: int(version.partition(".")[2]))


def check_contents(wheel: Path, source: Path) -> None:
    """The wheel was built from the source distribution, and has each file of both packages and nothing else."""
    there = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    if there != packed:
        sys.exit(f"{wheel.name} lacks {sorted(there - packed)} and shouldn't have {sorted(packed - there)}")
    with tarfile.open(source) as opened:
        names = {name.split("/")[1] for name in opened.getnames()}
    if missing := {*IN_THE_SOURCE, *PACKAGES, "pyproject.toml"} - names:
        sys.exit(f"{source.name} lacks {sorted(missing)}")
    sizes = [f"{path.name} {path.stat().st_size / 1e6:.1f} MB" for path in (wheel, source)]
    print(f"{', '.join(sizes)}; {len(packed)} files in the wheel")


def run(arguments: list[str | Path], folder: Path) -> str:
    """Run a command outside the repository; what it prints is shown where it fails."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, arguments))}\nended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def use(wheel: Path, python: str, folder: Path) -> str:
    """Install the wheel into a fresh environment in `folder`, and use it; how long both took."""
    start = time.perf_counter()
    run([python, "-m", "venv", folder / "venv"], folder)
    programs = folder / "venv" / "bin"
    run([programs / "python", "-m", "pip", "install", "--quiet", wheel], folder)
    installed = time.perf_counter()
    if (version := run([programs / "khop", "--version"], folder).strip()) != wheel.name.split("-")[1]:
        sys.exit(f"khop --version printed {version}, of {wheel.name}")
    for command in COMMANDS:
        if not run([programs / "khop", *command.split()], folder).strip():
            sys.exit(f"khop {command} printed nothing")
    loaded = run([programs / "python", "-c", CODE], folder).splitlines()
    shipped = sorted((ROOT / "agents" / "learning" / "pretrained").glob("*.npz"))
    if len(loaded) != len(shipped):
        sys.exit(f"{len(shipped)} policies are shipped, {len(loaded)} can be loaded: {loaded}")
    return f"installed in {installed - start:.0f} s, used in {time.perf_counter() - installed:.0f} s"


def main() -> None:
    """Find Pythons, check what is packed, and try the wheel on the oldest and the newest at once."""
    (wheel,), (source,) = Path(sys.argv[1]).resolve().glob("*.whl"), Path(sys.argv[1]).resolve().glob("*.tar.gz")
    check_contents(wheel, source)
    found = {version: python for version in supported() if (python := python_of(version))}
    if not found:
        sys.exit(f"found none of the supported Pythons: {', '.join(supported())}")
    tried = dict.fromkeys([min(found, key=supported().index), max(found, key=supported().index)])
    for version in supported():
        fate = "tried" if version in tried else "between them, not tried" if version in found else "not found"
        print(f"Python {version}: {fate} {found.get(version, '')}")
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor() as pool:
        folders = {version: Path(place) / version for version in tried}
        for folder in folders.values():
            folder.mkdir()
        running = {version: pool.submit(use, wheel, found[version], folders[version]) for version in tried}
        for version, result in running.items():
            print(f"Python {version}: {result.result()}")


if __name__ == "__main__":
    main()
