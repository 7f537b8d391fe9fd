#!/usr/bin/env bash
# cv::FileStorage, opencv-python-headless 4.12 and 5.0, and PyYAML 6.0.3: OpenCV 4 begins a YAML file
# with `%YAML:1.0`, a directive that no version of YAML has, so that PyYAML refuses every calibration
# that OpenCV has written so far. OpenCV 5 begins it with `%YAML 1.2`, which PyYAML takes; what stops
# it then is the tag `!!opencv-matrix`, in both. OpenCV 4 reads the files of OpenCV 5.
# Seen: ScannerError for the file of 4.12, ConstructorError for that of 5.0, and both read by 4.12.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > write.py <<'PYTHON'
import sys

import cv2
import numpy as np

file = cv2.FileStorage(sys.argv[1], cv2.FILE_STORAGE_WRITE)
file.write("camera_matrix", np.diag([500.0, 510.0, 1.0]))
file.release()
PYTHON
for version in 4.12.0.88 5.0.0.93; do
    python3 -m venv "venv$version"
    "venv$version/bin/pip" install --quiet "opencv-python-headless==$version" PyYAML==6.0.3
    "venv$version/bin/python" write.py "$version.yaml"
done
venv4.12.0.88/bin/python - <<'PYTHON'
import cv2
import yaml

refused = {}
for version in ("4.12.0.88", "5.0.0.93"):
    with open(f"{version}.yaml") as file:
        text = file.read()
    try:
        yaml.safe_load(text)
        refused[version] = ""
    except yaml.YAMLError as error:
        refused[version] = type(error).__name__
    read = cv2.FileStorage(f"{version}.yaml", cv2.FILE_STORAGE_READ)
    matrix = read.getNode("camera_matrix").mat()
    print(version, repr(text.splitlines()[0]), refused[version], "read by 4.12:", matrix[1, 1])
    assert matrix[1, 1] == 510.0
assert refused == {"4.12.0.88": "ScannerError", "5.0.0.93": "ConstructorError"}
PYTHON
