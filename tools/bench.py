"""Measures the program against the machine, as ratios within one run.

    python tools/bench.py updates     SAC updates inside the real program, against the peak of matrix products
    python tools/bench.py pieces      what XLA makes of one SAC update: products, fusions and copies inside the loop
    python tools/bench.py capacity    cost of a step at a large and at a small replay capacity
    python tools/bench.py program     cost of a step of the whole program, against its SAC updates alone
    python tools/bench.py profile     where the time of an epoch and its evaluation goes (default: the quick start)
    python tools/bench.py envs        steps per second and compile seconds of every task, on each backend and batch size
    python tools/bench.py host        host simulators stepped in a loop, by threads and by processes
    python tools/bench.py hosted      what a step around a host simulator costs besides simulating and learning
    python tools/bench.py compare     one policy of MBPO, here and in mbrl-lib (benches/peer.py says what it needs)

Further arguments are settings, as for `vecpsmbpo train` (of `envs`: tasks). One line of JSON per measurement, when it
is made, with what was measured and on what machine.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools import provenance
from tools.benches import epoch, peer, pieces, program, simulators
from vecpsmbpo import arguments
from vecpsmbpo.settings import SettingError

BENCHES = {
    "updates": program.bench_updates,
    "pieces": pieces.bench_pieces,
    "capacity": program.bench_capacity,
    "program": program.bench_program,
    "profile": epoch.bench_profile,
    "envs": simulators.bench_envs,
    "host": simulators.bench_host,
    "hosted": simulators.bench_hosted,
    "compare": peer.compare,
}


def main(words: Sequence[str]) -> int:
    if not words or words[0] not in BENCHES:
        raise SettingError(f"takes one of {', '.join(BENCHES)}, then settings")
    about = {"bench": words[0], **provenance.everything()}  # before: it may be changed while it is measured
    results = BENCHES[words[0]](words[1:])
    for result in [results] if isinstance(results, dict) else results:
        # After: what is measured says how many devices there are. `compare` leaves them to the programs it starts.
        has_devices = words[0] != "compare"
        devices = {"devices": jax.device_count(), "platform": jax.default_backend()} if has_devices else {}
        print(json.dumps({**about, **devices, **result}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(arguments.as_tool("bench", main, __doc__, {}))
