"""Pages and their files as they go over the wire."""

import re

import numpy as np
from pytest import mark, raises

from ground_service.errors import InvalidInput
from ground_service.evaluation.extras import WIDTH_PX
from ground_service.web.pages import PAGES, POLICY, basemap_jpeg
from tests.ground_service.conftest import cells
from tests.ground_service.web.test_displays import ask
from tests.lazy import Lazy

cv2 = Lazy("cv2")

PATHS = [page.path.replace("{pass_id}", "1").replace("{revision}", "0" * 16) for page in PAGES]


@mark.parametrize("path", PATHS)
def test_a_page_runs_only_scripts_of_this_service(service, path):
    status, body, headers = ask(service.url + path)
    assert status == 200
    assert headers["Content-Security-Policy"] == POLICY
    assert "unsafe" not in POLICY and "https:" not in POLICY
    for source in re.findall(rb'(?:src|href)="([^"]+)"', body):
        assert source.startswith((b"/", b"#", b"data:")), source
        if source.startswith(b"/static/"):
            assert ask(service.url + source.decode())[0] == 200, source


ENTRIES = """
/passes/1 | Passes
/missions/00000000 | Missions
/audit | Audit
"""


@mark.parametrize("path, entry", cells(ENTRIES))
def test_the_navigation_marks_the_page_that_a_detail_belongs_to(service, path, entry):
    _, body, _ = ask(service.url + path)
    assert re.findall(rb'aria-current="page">([^<]+)<', body) == [entry.encode()]


def test_files_with_a_version_are_kept_and_without_one_are_asked_for_again(service):
    _, body, _ = ask(service.url + "/")
    (address,) = re.findall(rb'href="(/static/site\.css\?v=[0-9a-f]+)"', body)
    assert "immutable" in ask(service.url + address.decode())[2]["Cache-Control"]
    assert ask(service.url + "/static/site.css")[2]["Cache-Control"] == "no-cache"


@mark.parametrize(
    "path", ["/static/../pages.py", "/static/%2e%2e/pages.py", "/static/nothing.js", "/static/", "/static//etc/passwd"]
)
def test_no_other_file_can_be_reached(service, path):
    assert ask(service.url + path)[0] == 404


def test_every_library_comes_with_its_licence_and_the_map_needs_the_albedo_product(service):
    _, body, _ = ask(service.url + "/licences")
    assert b"Permission is hereby granted" in body  # uPlot, MIT
    assert b"Redistribution and use in source and binary forms" in body  # Leaflet, BSD-2-Clause
    assert b"Apache License" in body  # Swagger UI
    assert ask(service.url + "/moon.jpg")[0] == 404


def test_the_map_is_stretched_over_the_grey_values_and_half_as_high_as_wide(tmp_path):
    dull = np.tile(np.linspace(38, 112, 512).astype(np.uint8), (256, 1))
    path = tmp_path / "albedo.png"
    cv2.imwrite(str(path), dull)
    drawn = cv2.imdecode(np.frombuffer(basemap_jpeg(path), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert drawn.shape == (WIDTH_PX // 2, WIDTH_PX)
    assert drawn[:, :20].mean() < 50 and drawn[:, -20:].mean() > 210


def test_a_map_that_is_no_picture_is_named(tmp_path):
    path = tmp_path / "albedo.jpg"
    path.write_bytes(b"nothing of the kind")
    with raises(InvalidInput, match=r"albedo\.jpg"):
        basemap_jpeg(path)
