# Sourced by the commands beside it: a virtual environment in .venv with this checkout and the extras given in $1.
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-python3}
[ -x .venv/bin/python ] || "$python" -m venv .venv
.venv/bin/python -m pip install --quiet --disable-pip-version-check --use-pep517 --editable ".$1"
