# Sourced by the commands beside it: a virtual environment in .venv with this checkout and the extras given in $1.
# PYTHON=... says which interpreter makes it; else the first of those below that will do. Only what bash 3.2 knows:
# macOS has no newer one.
cd "$(dirname "${BASH_SOURCE[0]}")/.."
supported="3.11 3.12 3.13" # as in pyproject.toml

version_of() { # of an interpreter, as 3.12; nothing if it does not run
    "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null || true
}

is_supported() {
    case " $supported " in *" $1 "*) [ -n "$1" ] ;; *) false ;; esac
}

give_up() {
    echo "$0: $1" >&2
    exit 2
}

if [ -e .venv ]; then
    is_supported "$(version_of .venv/bin/python)" && .venv/bin/python -c 'import pip' 2>/dev/null ||
        give_up ".venv is not whole, or its Python is none of $supported; rm -r .venv and run this again"
else
    chosen="" others=""
    for python in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        version=$(version_of "$python")
        if [ -z "$version" ]; then
            others="$others${PYTHON:+; $python does not run}"
        elif ! is_supported "$version"; then
            others="$others; $python is $version"
        elif ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
            others="$others; $python cannot make virtual environments (Debian, Ubuntu: apt install python$version-venv)"
        else
            chosen=$python
            break
        fi
    done
    [ -n "$chosen" ] || give_up "needs one of Python ${supported// /, }$others; install one and say PYTHON=/path/to/python $0"
    "$chosen" -m venv .venv || { rm -rf .venv; exit 1; }
fi

install() { .venv/bin/python -m pip install --quiet --disable-pip-version-check "$@"; }

install --use-pep517 --editable ".$1"
case "$(version_of .venv/bin/python)" in
    3.11 | 3.12) ;;
    *) # labmaze, which dm-control wants, has no wheel: pyproject.toml leaves dm-control out
        install --no-deps "$(sed -n 's/^ *"\(dm-control==[^;]*\);.*/\1/p' pyproject.toml)"
        ;;
esac
