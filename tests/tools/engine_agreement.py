"""How far contacts of the same probe are apart in two engines, in all configurations.

python -m tests.tools.engine_agreement
"""

import time
from itertools import combinations

import numpy as np

from runners.objects.loader import MODELS, OBJECTS, load_model
from runners.sessions.configurations import CONFIGURATIONS
from runners.sessions.physics_engine import ENGINES
from runners.sessions.probing import open_probing
from runners.sessions.probing_settings import ProbingSettings

KINDS = {"kinematic": ("kinematic", None), **{name: ("simulated", name) for name in ENGINES}}


def main():
    found, seconds = {}, dict.fromkeys(KINDS, 0.0)
    for name, configuration in CONFIGURATIONS.items():
        shipped = next(one for one in OBJECTS.values() if one.name == configuration.object)
        mesh = load_model(configuration.object, shipped.scale)
        for label, (kind, engine) in KINDS.items():
            begun = time.process_time()
            settings = ProbingSettings(engine=engine)
            session = open_probing(kind, mesh, configuration_name=name, settings=settings, seed=0)
            found[label, name] = list(session.probes())
            session.close()
            seconds[label] += time.process_time() - begun
    probes = sum(len(found["kinematic", name]) for name in CONFIGURATIONS)
    print(f"{probes} probes of {len(CONFIGURATIONS)} configurations, {len(MODELS)} objects")
    print("processor time:", ", ".join(f"{name} {value:.0f} s" for name, value in seconds.items()))
    for one, other in combinations(KINDS, 2):
        distances, alone = [], 0
        for name in CONFIGURATIONS:
            for a, b in zip(found[one, name], found[other, name], strict=True):
                if len(a.contacts) != len(b.contacts):
                    alone += 1
                elif len(a.contacts):
                    distances.append(np.sqrt(((a.contacts - b.contacts) ** 2).sum(axis=1)).max())
        median, most = 1000.0 * np.quantile(distances, [0.5, 0.95])
        print(
            f"{one} and {other}: {len(distances)} contacts, {median:.2f} mm apart (median), "
            f"{most:.2f} mm (95 %), {alone} probes touch in one of them alone"
        )


if __name__ == "__main__":
    main()
