"""`cmig register --pairs`: a row per pair, what one bad pair does, and how an interrupted run continues."""

import csv
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.registration import register as module
from cmig_jax.registration.result import Registration
from cmig_jax.transform import RigidTransform

R = Rotation.from_euler("zyx", [30, 20, 10], degrees=True).as_matrix()


def planes(seed, count=300):
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [4, 3, 2]
    points[np.arange(count), np.arange(count) % 3] = 0
    return points


@pytest.fixture
def files(tmp_path):
    """Two clouds that belong together, one that does not, one that is none."""
    (tmp_path / "clouds").mkdir()
    np.save(tmp_path / "clouds/a.npy", planes(0))
    np.save(tmp_path / "clouds/b.npy", planes(0) @ R.T + 1)
    np.save(tmp_path / "clouds/other.npy", np.random.default_rng(1).normal(size=(300, 3)))
    (tmp_path / "clouds/bad.npy").write_bytes(b"no array")
    return tmp_path


@pytest.fixture
def listed(files):
    def write(*rows, header="source,target"):
        (files / "clouds/list.csv").write_text("\n".join([header, *rows]) + "\n")
        return "--pairs", files / "clouds/list.csv", "--out", files / "out"

    return write


@pytest.fixture
def asked(monkeypatch):
    """Replace `register` by one that takes no time, trusts all, and notes what it is asked."""
    calls = []

    def answer(source, target, network, **options):
        calls.append((len(source), len(target), options))
        if len(calls) == getattr(answer, "interrupted_at", None):
            raise KeyboardInterrupt
        pose = RigidTransform(R=R, t=np.array([1.0, 2, 3]))
        none = np.zeros((0, 2), np.int64)
        return Registration(pose, True, "aligned, say", 0.875, (0.5, 0.25), 0.01, none, np.eye(6), (), (0, 0), {})

    monkeypatch.setattr(module, "register", answer)
    return calls, answer


def results(files):
    with (files / "out/results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_each_pair_has_a_row_and_one_bad_pair_does_not_stop_the_others(main, files, listed):
    done = main("register", *listed("bad.npy,b.npy", "a.npy,b.npy", f"a.npy,{files / 'clouds/other.npy'}", "a.npy,none.npy"))
    assert done.returncode == 2
    rows = results(files)
    assert [(row["name"], row["source"], row["trusted"]) for row in rows] == [
        ("1", "bad.npy", ""),
        ("2", "a.npy", "True"),
        ("3", "a.npy", "False"),
        ("4", "a.npy", ""),
    ]
    assert "bad.npy: not a readable NPY file" in rows[0]["error"]
    assert "none.npy" in rows[3]["error"]
    matrix = np.array([float(rows[1][f"m{i}{j}"]) for i in range(4) for j in range(4)]).reshape(4, 4)
    np.testing.assert_allclose(matrix[:3, :3], R, atol=1e-6)
    np.testing.assert_allclose(matrix[:, 3], [1, 1, 1, 1], atol=1e-6)
    assert rows[1]["why"] == "aligned"
    assert 0 < float(rows[1]["seconds"]) < 60
    assert float(rows[1]["confidence"]) > float(rows[2]["confidence"])
    assert min(float(rows[1]["overlap_source"]), float(rows[1]["overlap_target"])) > 0.9
    assert "4 pairs: 1 trusted, 1 not, 2 with an error" in done.stdout
    assert "1: " in done.stdout


def test_the_exit_code_says_whether_all_are_trusted(main, files, listed):
    quiet = main("register", *listed("a.npy,b.npy"), "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    assert main("register", *listed("a.npy,b.npy", "a.npy,other.npy")).returncode == 1


def test_a_pair_may_have_a_name_and_a_bound_of_its_own(main, files, listed, asked):
    command = listed("near,40,b.npy,a.npy,x", "up,yaw,b.npy,a.npy,", ",,b.npy,a.npy,", header="Name, rotations, target, source, more")
    assert main("register", *command, "--rotations", "90").returncode == 0
    assert sorted(str(options["rotations"]) for _, _, options in asked[0]) == ["40.0", "90.0", "yaw"]
    assert [row["name"] for row in results(files)] == ["near", "up", "3"]
    assert main("register", *listed("a.npy,b.npy,fast", header="source,target,rotations")).returncode == 2
    assert results(files)[0]["error"] == "rotations 'fast'; expected any, yaw, or an angle in degrees"


def test_an_interrupted_run_continues_and_a_line_cut_short_is_done_again(main, files, listed, asked, monkeypatch):
    calls, answer = asked
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    for i in range(5):
        np.save(files / f"clouds/{i}.npy", planes(i, 200 + i))
    command = listed(*(f"{i}.npy,b.npy" for i in range(5)))
    answer.interrupted_at = 4
    done = main("register", *command)
    assert (done.returncode, "stopped after 3 of 5 pairs; the same command continues" in done.stderr) == (130, True)
    assert [row["source"] for row in results(files)] == ["0.npy", "1.npy", "2.npy"]
    whole = (files / "out/results.csv").read_bytes()
    (files / "out/results.csv").write_bytes(whole[:-40])
    calls.clear()
    answer.interrupted_at = None
    done = main("register", *command)
    assert done.returncode == 0, done.stderr
    assert [source for source, _, _ in calls] == [202, 203, 204]
    assert [row["source"] for row in results(files)] == [f"{i}.npy" for i in range(5)]
    assert "2 were there before" in done.stdout
    assert (files / "out/results.csv").read_bytes().count(b"\n") == 6


def test_what_has_changed_is_registered_again(main, files, listed, asked):
    calls, _ = asked
    rows = ("a.npy,b.npy", "other.npy,b.npy", "bad.npy,b.npy")

    def again(*options, rows=rows):
        calls.clear()
        main("register", *listed(*rows), *options)
        return sorted(source for source, _, _ in calls)

    assert again() == [300, 300]
    assert again() == []
    assert again("--rotations", "90") == [300, 300]
    np.save(files / "clouds/a.npy", planes(0, 240))
    np.save(files / "clouds/bad.npy", planes(0, 250))
    assert again("--rotations", "90") == [240, 250]
    assert again("--rotations", "90", rows=rows[::-1]) == []
    assert [row["source"] for row in results(files)] == ["bad.npy", "other.npy", "a.npy"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.npy,b.npy\n", "list.csv: columns a.npy, b.npy and 0 rows; expected source, target and a row per pair"),
        ("source,target\n", "columns source, target and 0 rows; expected source, target and a row per pair"),
        ("", "columns none and 0 rows; expected source, target"),
        ("source,target\n\xff", "list.csv: not a readable CSV file"),
    ],
)
def test_a_list_that_is_none_is_one_line(main, files, text, message):
    (files / "list.csv").write_bytes(text.encode("latin-1"))
    done = main("register", "--pairs", files / "list.csv", "--out", files / "out")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {files / 'list.csv'}: ")
    assert message in done.stderr
    assert not (files / "out").exists()


def test_a_results_file_of_something_else_is_not_replaced(main, files, listed):
    (files / "out").mkdir()
    (files / "out/results.csv").write_text("my,results\n1,2\n")
    done = main("register", *listed("a.npy,b.npy"))
    assert done.returncode == 2
    assert "results.csv: not a file of this command; expected another folder as --out" in done.stderr
    assert (files / "out/results.csv").read_text() == "my,results\n1,2\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "0 files; expected SOURCE TARGET, or --pairs LIST.csv --out DIR, or --sequence SCAN SCAN ... --out DIR"),
        (("a", "b", "c"), "3 files; expected SOURCE TARGET, or"),
        (("a", "b", "--out", "o"), "2 files and --out; expected SOURCE TARGET, or"),
        (("--pairs", "l.csv"), "no --out; expected a folder for what --pairs writes"),
        (("--sequence", "a", "b"), "no --out; expected a folder for what --sequence writes"),
        (("--pairs", "l.csv", "--out", "o", "--json"), "--json: expected with SOURCE TARGET alone"),
        (("--sequence", "a", "b", "--out", "o", "--view", "v.html"), "--view: expected with SOURCE TARGET alone"),
        (("a", "b", "--pairs", "l.csv", "--out", "o"), "--pairs l.csv with 2 files or --sequence; expected neither"),
        (("--sequence", "--pairs", "l.csv", "--out", "o"), "--pairs l.csv with 0 files or --sequence; expected neither"),
        (("--sequence", "a", "--out", "o"), "--sequence with 1 files; expected two or more scans"),
        (("--sequence", "a", "b", "--out", "o", "--no-refine"), "--sequence with 2 files and --no-refine; expected"),
        (("--pairs", "none.csv", "--out", "o"), "none.csv"),
        (("--sequence", "none.ply", "b.ply", "--out", "o"), "none.ply"),
    ],
)
def test_options_that_do_not_belong_together_say_what_was_expected(main, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = main("register", *arguments)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("rotations", ["any", "45"])
def test_pairs_per_second(main, files, listed, rotations):
    """`pytest -m slow -s tests/commands/test_register_pairs.py` prints pairs of 384 points per second, and CPU time."""
    for i in range(64):
        np.save(files / f"clouds/a{i}.npy", planes(2 * i, 384))
        np.save(files / f"clouds/b{i}.npy", planes(2 * i + 1, 384) @ R.T + 1)
    command = listed(*(f"a{i}.npy,b{i}.npy" for i in range(64)))
    begin, busy = time.perf_counter(), time.process_time()
    assert main("register", *command, "--rotations", rotations).returncode < 2
    wall, busy = time.perf_counter() - begin, time.process_time() - busy
    print(f"\nrotations {rotations}: {64 / wall:.1f} pairs/s, {busy / 64:.2f} s of CPU time each")
