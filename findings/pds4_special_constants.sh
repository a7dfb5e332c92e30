#!/usr/bin/env bash
# Special constants of scaled images with PDS4 labels (Python 3.11, pds4_tools 1.4, numpy 2.4.6)
#
# The image has the samples -32768, -16384, 0, 100, 16000, 32000, the scaling factor 2, the missing constant -32768 and
# the saturated constant 32000. The label compares constants with stored samples, before scaling.
# Guess: the constants are masked or NaN, and exactly two samples are masked by as_masked().
# Seen:  constants stay as they are among the scaled values, and as_masked() compares with scaled values: it also masks the
#        valid samples -16384 and 16000, because twice their value equals a constant.
# Guess: as_masked() also masks samples below valid_minimum and above valid_maximum.
# Seen:  these limits have no effect.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile pds4_tools==1.4 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import numpy as np
import pds4_tools

LABEL = """<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1">
<Identification_Area><logical_identifier>urn:nasa:pds:a:b:c</logical_identifier><version_id>1.0</version_id>
<title>a</title><information_model_version>1.16.0.0</information_model_version>
<product_class>Product_Observational</product_class></Identification_Area>
<File_Area_Observational><File><file_name>a.img</file_name></File>
<Array_2D_Image><offset unit="byte">0</offset><axes>2</axes><axis_index_order>Last Index Fastest</axis_index_order>
<Element_Array><data_type>SignedMSB2</data_type>{scaling}</Element_Array>
<Axis_Array><axis_name>Line</axis_name><elements>2</elements><sequence_number>1</sequence_number></Axis_Array>
<Axis_Array><axis_name>Sample</axis_name><elements>3</elements><sequence_number>2</sequence_number></Axis_Array>
<Special_Constants>{constants}</Special_Constants></Array_2D_Image></File_Area_Observational></Product_Observational>"""
CONSTANTS = "<saturated_constant>32000</saturated_constant><missing_constant>-32768</missing_constant>"

def image(scaling, constants):
    with open("a.xml", "w") as file:
        file.write(LABEL.format(scaling=scaling, constants=constants))
    return pds4_tools.read("a.xml", quiet=True)[0]

np.array([-32768, -16384, 0, 100, 16000, 32000], dtype=">i2").tofile("a.img")
plain = image("", CONSTANTS).as_masked().data.tolist()
scaled = image("<scaling_factor>2</scaling_factor>", CONSTANTS)
print(plain, scaled.data.tolist(), scaled.as_masked().data.tolist())
assert plain == [[None, -16384, 0], [100, 16000, None]]
assert scaled.data.tolist() == [[-32768, -32768, 0], [200, 32000, 32000]]
assert scaled.as_masked().data.tolist() == [[None, None, 0], [200, None, None]]
limits = image("", "<valid_minimum>0</valid_minimum><valid_maximum>200</valid_maximum>").as_masked().data.tolist()
assert limits == [[-32768, -16384, 0], [100, 16000, 32000]]
EOF
