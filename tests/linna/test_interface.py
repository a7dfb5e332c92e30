"""Commands and options on which scripts rely keep their names."""

import pytest

from linna.cli import GROUPS
from linna.help import example
from linna.parser import command_parser
from tmtc.dictionary.payload import DICTIONARY

RELIED_ON = """
demo --out D
orbit propagate S --days 1 --step 30 --out F.oem --gravity G --degree 8 --no-maneuvers
orbit compare A B
orbit interpolate F --epochs E
catalogue stats F
catalogue curate C --terrain T --out F
camera fov-study --ephemeris F --catalogue C
render S --epoch 2029-08-07T00:00:00Z --out F.png --renderer raymarch
dataset build S --out D --frames 5 --workers 2 --renderer fast
dataset check D
dataset stats D
detector train D --out R
detector export R --out M.onnx
detector evaluate --model M --dataset D --split test
detector evaluate --model M --coco D --altitude-km 30
detector detect I.png --altitude-km 30 --fov-deg 120
detector bench --threads 2
emulate S --out D --mode anchored
replay A --build B --out D
tm decode F --format parquet --out G
tm check F
tm icd
tm xtce --out F.xml
tm yamcs --out D
serve --host 127.0.0.1 --port 1
worker
db upgrade
user add NAME --role viewer
ingest --recording R F G
pass list
pass show 1
report 1 --out D
regress run --archive A --build B --baseline C --junit J
regress suite low --out D
data verify
mission write S --out M.toml
mission check M
mission run S --days 1 --speed max
verify --rebuild
navigation survey --region 0,10,0,10 --seeds 3
export 1 --format tum --out F
paper --out D
link check F --mission M
"""


@pytest.mark.parametrize("line", RELIED_ON.strip().splitlines())
def test_a_documented_command_is_understood(line: str) -> None:
    words = line.split()
    command_parser(GROUPS, words[0]).parse_args(words)


def test_the_example_of_a_telecommand_is_one_of_the_dictionary() -> None:
    assert example("linna command enter").split()[3] in {one.name for one in DICTIONARY.telecommands}
