#!/usr/bin/env bash
# Dates without a day and words in PDS3 labels (Python 3.11, pvl 1.3.2)
#
# The PDS3 standard allows dates without a day: START_TIME = 1987-04 is April 1987.
# Guess: pvl returns the text, or the first of April.
# Seen:  it returns the 4th of January 1987 with each of its decoders: it takes the month as the day of the year.
# Guess: a word that is not a PDS3 number, such as 17_03, INF or NAN, is text.
# Seen:  17_03 is the integer 1703, INF and NAN are floating-point numbers, also with the strict PDS3 decoder.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile pvl==1.3.2
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import datetime
import math
import pvl

strict = {"grammar": pvl.grammar.PDSGrammar(), "decoder": pvl.decoder.PDSLabelDecoder()}
for options in ({}, strict):
    label = pvl.loads("START_TIME = 1987-04\nSTOP_TIME = 1987-12\nPRODUCT_ID = 17_03\nA = INF\nB = NAN\nEND\n", **options)
    print(dict(label))
    assert label["START_TIME"] == datetime.date(1987, 1, 4)
    assert label["STOP_TIME"] == datetime.date(1987, 1, 12)
    assert label["PRODUCT_ID"] == 1703 and isinstance(label["PRODUCT_ID"], int)
    assert math.isinf(label["A"]) and math.isnan(label["B"])
EOF
