#!/usr/bin/env bash
# PyBullet 3.2.6, whose wheel for Python 3.11 asks for no numpy at all, was built for numpy 1: beside
# numpy 2 `import pybullet` raises ImportError, after two pages of advice on stderr. Whoever resolves
# to the lowest versions of `pybullet>=3.2.6` gets both. 3.2.7 is built for numpy 2.
# Seen: numpy 2.0.0; "numpy.core.multiarray failed to import" with 3.2.6, an import with 3.2.7.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
try() {
    "$folder/venv/bin/pip" install --quiet --only-binary pybullet "pybullet==$1" numpy==2.0.0
    "$folder/venv/bin/python" -c "
try:
    import pybullet
    print('imports')
except ImportError as error:
    print('ImportError:', ' '.join(str(error).split()))
" 2>/dev/null | tail -1
}
old=$(try 3.2.6)
new=$(try 3.2.7)
echo "3.2.6: $old"
echo "3.2.7: $new"
[[ $old == ImportError:* ]]
[[ $new == imports || $new == *imports ]]
