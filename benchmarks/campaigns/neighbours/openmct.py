"""Open MCT in Chromium on the pages of the service: series that its telemetry interface gives.

The campaign runs this with the interpreter of this project; `NODE_PATH` names the folder of the package.
"""

import os
from pathlib import Path
from shutil import copytree

from _cells import run

from benchmarks.pages import open_chromium, served
from lunar.utc import parse_utc

READ = """async ([start, end, name]) => {
  const craft = (await (await fetch('/api/v1/spacecraft')).json()).items[0];
  const key = ['parameter', craft.spacecraft_id, craft.instance, name].join('~');
  const object = await openmct.objects.get({ namespace: 'linna', key });
  const found = await openmct.telemetry.request(object, { start, end, size: 100000 });
  return found.map((each) => [each.utc, each.value]);
}"""


def openmct(cells):
    """Compare series of housekeeping with the table of the pass."""
    home = copytree(cells.sample("ground"), cells.out / "home")
    os.environ |= {"LINNA_OPENMCT": str(Path(os.environ["NODE_PATH"]) / "openmct"), "LINNA_LINKS": "false"}
    header, *rows = cells.expected["tables"]["housekeeping"]
    times = [float(parse_utc(row[0]) // 1_000_000) for row in rows]
    with served(home) as url, open_chromium() as browser:
        page = browser.new_page()
        page.goto(f"{url}/mct")
        page.get_by_role("tree", name="Main Tree").wait_for(timeout=120_000)

        def series(name):
            found = page.evaluate(READ, [times[0] - 1000, times[-1] + 1000, name])
            return [[float(at), float(value)] for at, value in found]

        for name in ("temperature_c", "bus_voltage_v"):
            place = header.index(name)
            right = [[at, row[place]] for at, row in zip(times, rows, strict=True)]
            cells.reads(f"series {name}", right, lambda name=name: series(name))


run(globals())
