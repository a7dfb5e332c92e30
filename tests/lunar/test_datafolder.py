"""What is found in a data folder, and what is used in its place."""

import pytest

from lunar.datafolder import DataFolder, default_orientation, find_data
from lunar.errors import DataFileError


def test_without_a_folder_nothing_is_found_and_the_iau_series_is_used():
    data = find_data(None)
    assert data == DataFolder()
    assert data.names() == ()
    assert default_orientation(data).name == "IAU WGCCRE 2009"


def test_an_empty_folder_holds_nothing(tmp_path):
    data = find_data(tmp_path)
    assert data.root == tmp_path
    assert data.names() == ()


@pytest.mark.parametrize("name", ["absent", "file"])
def test_what_is_no_folder_is_refused(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataFileError, match="expected a data folder"):
        find_data(tmp_path / name)


@pytest.mark.real_data
def test_the_whole_data_folder_is_recognised(data_path):
    data = find_data(data_path)
    missing = [name for name in DataFolder.__slots__ if not getattr(data, name)]
    # What `linna data fetch` adds: a finer height model and a calibrated albedo.
    assert missing == ["dem_sldem", "albedo_tiles"]
    assert len(data.names()) == 10
    assert default_orientation(data).name == "DE421"
    assert len(data.dem_tiles) == len(list((data_path / "dem").glob("*ppd_*E_*.jp2")))


def test_heights_and_craters_of_a_user_are_named_by_their_files(tmp_path):
    for name in ("dem/own-pole.tif", "craters/own.csv"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    assert find_data(tmp_path).names() == ("crater catalogue own.csv", "own heights own-pole.tif")
