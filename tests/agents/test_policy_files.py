"""Policy files from untrusted sources: valid files are read, all others refused with their name."""

import io
import json
import zipfile

import numpy as np
import pytest

from agents import describe, make_policy
from agents.learning import PRETRAINED, LearnedPolicy, PolicyFileError
from agents.learning.archive import ArchiveError, read_arrays, write_arrays
from tests.env.playing import batched

GOOD = PRETRAINED / "leader_following_mixed_fleet.npz"  # with headings, so that every index array is used
MUTATIONS = 300


def contents():
    return read_arrays(GOOD, 2**24)


def change_meta(arrays, rng):
    meta = json.loads(str(arrays["meta"]))
    inner = meta if rng.random() < 0.6 else rng.choice([meta["about"], meta["layers"]])
    key = rng.choice(list(inner))
    values = [None, -1, 0, 10**30, 1.5, "text", [], {}, [1], {"": 1e300}, True, "consensus_v0", ["a"] * 5]
    if rng.random() < 0.3:
        del inner[key]
    else:
        inner[key] = values[rng.integers(len(values))]
    arrays["meta"] = np.array(json.dumps(meta))


def change_array(arrays, rng):
    name = rng.choice(list(arrays))
    array = arrays[name]
    changes = [
        lambda: array.astype(str),
        lambda: array.astype("complex128") if array.dtype.kind in "if" else np.array([]),
        lambda: array[..., None],
        lambda: array.reshape(-1)[: array.size // 2],
        lambda: np.full(array.shape, np.nan, np.float32),
        lambda: np.full(array.shape, np.inf),
        lambda: array + 10**6 if array.dtype.kind in "if" else array,
        lambda: -array - 7 if array.dtype.kind in "if" else array,
        lambda: array.astype(np.float64) if array.dtype.kind in "if" else array,
        lambda: np.zeros((0, 3)),
        lambda: np.zeros(3, [("a", "f4")]),
    ]
    arrays[name] = changes[rng.integers(len(changes))]()


def rename(arrays, rng):
    name = rng.choice(list(arrays))
    arrays[str(rng.choice(["", "meta", "0/0/weight", "../meta", name + "x"]))] = arrays.pop(name)


def damaged(content, rng):
    """Bytes flipped, cut out, put in, or the end missing."""
    spoilt, kind = bytearray(content), rng.integers(4)
    place = int(rng.integers(len(spoilt)))
    if kind == 0:
        for at in rng.integers(len(spoilt), size=rng.integers(1, 20)):
            spoilt[at] = rng.integers(256)
    elif kind == 1:
        del spoilt[place:]
    elif kind == 2:
        del spoilt[place : place + int(rng.integers(1, 100))]
    else:
        spoilt[place:place] = rng.bytes(int(rng.integers(1, 100)))
    return bytes(spoilt)


def mutated(rng):
    arrays = contents()
    kind = rng.integers(5)
    if kind == 0:
        return damaged(GOOD.read_bytes(), rng)
    for _ in range(rng.integers(1, 3)):
        [change_meta, change_array, rename, lambda arrays, rng: arrays.pop(rng.choice(list(arrays)))][kind - 1](
            arrays, rng
        )
    stream = io.BytesIO()
    (np.savez if rng.random() < 0.5 else np.savez_compressed)(stream, **arrays)
    return stream.getvalue()


def test_every_mutation_is_refused_by_name_or_acts(tmp_path):
    """Either a policy with actions in [-1, 1], or a PolicyFileError that names the file."""
    rng, refused = np.random.default_rng(0), []
    env = batched("leader_following_v0", "mixed_fleet", num_envs=1)
    observations = dict(zip(env.agents, env.reset(0)[0].swapaxes(0, 1), strict=True))
    for number in range(MUTATIONS):
        path = tmp_path / f"{number}.npz"
        path.write_bytes(mutated(rng))
        try:
            policy = LearnedPolicy.load(path)
        except PolicyFileError as error:
            refused.append((path, str(error)))
            continue
        try:
            policy.reset(describe(env), [0])
        except PolicyFileError:
            continue
        for action in policy.act(observations).values():
            assert np.all(np.abs(action) <= 1.0)
    assert len(refused) > 0.7 * MUTATIONS
    assert all(str(path) in said and len(said) < 500 + len(str(path)) for path, said in refused)


def with_member(name, content):
    """The content of a valid file with one member replaced."""
    stream = io.BytesIO()
    with zipfile.ZipFile(GOOD) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
        for member in old.infolist():
            new.writestr(member.filename, content if member.filename == name else old.read(member))
        if name not in old.namelist():
            new.writestr(name, content)
    return stream.getvalue()


def npy(array, **options):
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


class Payload:
    """Code that a pickle executes when it is loaded."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was read",)


HUGE = npy(np.zeros(1)).replace(b"(1,), }" + b" " * 10, b"(99999999999,), }")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "it is empty"),
        (npy(np.zeros(3)), "File is not a zip file"),
        (GOOD.read_bytes()[:-30], "File is not a zip file"),
        (with_member("scale.npy", npy(np.array([Payload()]), allow_pickle=True)), "array of object"),
        (with_member("scale.npy", HUGE), r"doesn't match its header \(shape \(99999999999,\)"),
        (with_member("scale.npy", b"\x93NUMPY\x01\x00\x10\x27" + b"(" * 10000), "."),
        (with_member("meta.npy", npy(np.array('{"format": ' + "[" * 100_000))), "."),
        (with_member("planar.npy", npy(np.full((2, 2), 10**9))), "planar is out of range"),
        (with_member("moving.npy", npy(np.array([-1]))), "moving is out of range"),
        (with_member("rate.npy", npy(np.array(0.0))), "rate isn't positive"),
        (with_member("/0/bias.npy", npy(np.full(64, np.nan, np.float32))), "/0/bias isn't finite"),
        (with_member("/0/bias.npy", npy(np.full(64, "1.0"))), "/0/bias has dtype <U3; expected float32"),
    ],
    ids=range(12),
)
def test_crafted_files_are_refused(tmp_path, content, said):
    path = tmp_path / "crafted.npz"
    path.write_bytes(content)
    with pytest.raises(PolicyFileError, match=rf"crafted.npz isn't a policy that khop train wrote \(.*{said}"):
        make_policy(f"ppo:{path}")


def test_a_model_of_stable_baselines_is_told_how_to_play(tmp_path):
    path = tmp_path / "my_model.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("policy.pth", b"weights")
    with pytest.raises(PolicyFileError, match=r"is a model of Stable-Baselines3: .*PPO.load.*name my_sb3.py:policy"):
        make_policy(f"ppo:{path}")


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    """By the declared size; a file that declares less than it holds yields no more than it declares."""
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("scale.npy", "w") as member:
        for _ in range(300):
            member.write(bytes(2**20))
    assert path.stat().st_size < 2**20
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(PolicyFileError, match="it would unpack to 314,572,800 bytes; the limit is 268,435,456"):
        make_policy(f"ppo:{path}")
    monkeypatch.undo()
    path.write_bytes(path.read_bytes().replace((300 * 2**20).to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    with pytest.raises(PolicyFileError, match=r"bomb\.npz isn't a policy"):
        make_policy(f"ppo:{path}")


def test_archives_come_back_as_they_were(tmp_path):
    """Bit for bit, with and without compression, and nothing but plain arrays."""
    arrays = {"a": np.array([np.nan, -0.0]), "b": np.array("text"), "c": np.zeros((0, 3), np.int64)}
    for compress in (True, False):
        write_arrays(tmp_path / "new" / "x.npz", arrays, compress=compress)
        found = read_arrays(tmp_path / "new" / "x.npz", 10_000)
        assert {name: (array.dtype, array.shape, array.tobytes()) for name, array in found.items()} == {
            name: (array.dtype, array.shape, array.tobytes()) for name, array in arrays.items()
        }
        assert [path.name for path in (tmp_path / "new").iterdir()] == ["x.npz"]
    with pytest.raises(ArchiveError, match="isn't a regular file"):
        read_arrays(tmp_path, 10_000)
