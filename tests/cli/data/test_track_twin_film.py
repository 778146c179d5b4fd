"""`haselab track` on the twin's camera, whose clamps have edges beside the particles."""

import json

import numpy as np
import pandas as pd
import pytest
import tifffile

import haselab as hl
from haselab.cli.main import main
from haselab.rig.twin.camera import TwinCamera, TwinCameraConfig

STRETCH = 1.0 + np.r_[np.zeros(6), np.linspace(0.02, 0.2, 10)]


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """The twin's sheet, stretched by up to 20 %, as a folder of images."""
    folder = tmp_path_factory.mktemp("film")
    camera = TwinCamera(TwinCameraConfig(), half_width_m=0.06, free_length_m=0.05, seed=3)
    lengths = np.repeat(0.048 * STRETCH[:, None], 2, axis=1)
    for k, frame in enumerate(camera.render(lengths, first_index=0)):
        tifffile.imwrite(folder / f"f{k:03d}.tif", frame)
    return folder


def tracked(film, folder, capsys, *options):
    out = folder / "tracks.csv"
    with pytest.raises(SystemExit) as stop:
        main(["track", str(film), "--auto", "--count", "60", "--rest-frames", "5",
              "--rate-hz", "100", "--out", str(out), "--json", *options])  # fmt: skip
    assert stop.value.code == 0
    said = capsys.readouterr()
    return json.loads(said.out), said.err, pd.read_csv(out)


def errors_px(table):
    """Errors along the stretch, as the camera's model has it, and their stated deviations."""
    rest = table[table.frame < 5].groupby("point").y_px.mean()
    top = rest[rest.index.str.startswith("upper")].mean()
    found = table[(table.valid == 1) & (table.frame >= 5)]
    true_px = top + (rest[found.point].to_numpy() - top) * STRETCH[found.frame]
    return found.y_px.to_numpy() - true_px, found.std_y_px.to_numpy()


def test_a_stretching_sheet_beside_clamps_is_tracked_within_the_stated_deviations(
    film, tmp_path, capsys
):
    answer, said, table = tracked(film, tmp_path, capsys)
    error, std = errors_px(table)
    assert answer["model"] == "neighbours" and answer["valid_fraction"] == 1.0
    # 540 errors with deviations of their own: 1 +- 0.03 by chance. Before edges were left out, the
    # ratio was 1.7, and half of the positions were lost.
    assert 0.6 < np.sqrt(np.mean((error / std) ** 2)) < 1.25
    assert np.abs(error).max() < 0.25
    assert "notes" not in answer and "stretch" not in said


def test_python_tracks_as_the_command_does(film, tmp_path, capsys):
    for options, given in (((), None), (("--points",), [[200.0, 100.0], [256.0, 110.0]])):
        named = []
        if options:
            rows = "".join(f"p{k},{x},{y}\n" for k, (x, y) in enumerate(given))
            (tmp_path / "points.csv").write_text(f"point,x_px,y_px\n{rows}")
            named = [*options, tmp_path / "points.csv"]
        out = tmp_path / f"{len(named)}.csv"
        with pytest.raises(SystemExit):
            words = [film, "--rest-frames", "5", "--rate-hz", "100", "--out", out, *named]
            main(["track", *map(str, words)])
        capsys.readouterr()
        table = pd.read_csv(out)
        found = hl.track(film, None if given is None else np.array(given), rest_frames=5)
        assert np.array_equal(found["valid"], table.valid)
        for column in ("x_px", "std_y_px"):
            assert np.allclose(found[column], table[column], atol=1e-5, equal_nan=True)


def test_subsets_that_do_not_stretch_are_said_to_be_wrong_by_as_much_as_they_are(
    film, tmp_path, capsys
):
    answer, said, table = tracked(film, tmp_path, capsys, "--model", "translation")
    error, _ = errors_px(table)
    (note,) = answer["notes"]
    assert "move apart by up to 19.9 %" in note and note in said
    stated_px = float(note.partition("wrong by ")[2].partition(" px")[0])
    last = table[table.valid == 1].frame.max()
    at_most = error[table[(table.valid == 1) & (table.frame >= 5)].frame == last]
    assert 0.5 * stated_px < np.sqrt(np.mean(at_most**2)) < 1.5 * stated_px


def test_python_warns_of_subsets_that_do_not_follow_the_stretch(film):
    options = hl.tracking.TrackOptions(model="translation", subset_px=21)
    with pytest.warns(UserWarning, match=r"move apart by up to \d+\.\d %"):
        hl.track(film, options=options)


def test_a_point_that_stays_covered_is_named(film, tmp_path, capsys):
    covered = tmp_path / "covered"
    covered.mkdir()
    for k, file in enumerate(sorted(film.glob("*.tif"))):
        frame = tifffile.imread(file)
        if k >= 5:  # of 16 frames
            frame[60:160, 150:230] = 0
        tifffile.imwrite(covered / file.name, frame)
    rows = "p0,190,100\np1,256,110\np2,300,105\n"
    (tmp_path / "points.csv").write_text(f"point,x_px,y_px\n{rows}")
    line = ["track", covered, "--points", tmp_path / "points.csv", "--rest-frames", "5",
            "--rate-hz", "100", "--out", tmp_path / "tracks.csv", "--json"]  # fmt: skip
    with pytest.raises(SystemExit):
        main([str(word) for word in line])
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("1 of 3 points were lost and not found again until the end: p0." in n for n in notes)
