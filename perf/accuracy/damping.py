"""Compare the damping that simulated pairs show with that of recorded pairs, whose truth is known, by flow and rig.

    python perf/accuracy/damping.py --flows ring,swirl,turbulent:1.33 --pairs 32 --simulated 32
    python perf/accuracy/damping.py --flows ring --true flow,particles

Cases are those of `reconstruction_cases`. All recorded pairs show the flow, some of them their particles, as in a run.
`--true` replaces ingredients of the simulated pairs by the truth: the field that moves particles ("flow"), its means
over the windows ("means"), and number, size, places and light of the particles ("particles"). Vectors of recorded pairs
are stored by case; choose another `--cache` after a change to reconstruction or correlation.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np
import xarray as xr
from reconstruction_bench import CACHE
from reconstruction_cases import CONDITIONS, SIZE_MM, Case, Recorded, make_flow, make_rig, record, true_field
from reconstruction_ways import weights_of

from lfpiv.damping import bootstrap
from lfpiv.damping.particle_light import LightField
from lfpiv.damping.synthetic_pair import RecordedImages, RecordedParticles, SyntheticPair
from lfpiv.geometry.grid import Layers
from lfpiv.geometry.resampling import volume_on
from lfpiv.geometry.volume import lies_in
from lfpiv.joint.pair import PairSolver
from lfpiv.reconstruction.refinement import measure_size, needed_refinement
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reproduce.rigs import DT_S, VOXEL_MM
from lfpiv.runs.bootstrap import IMITATED
from lfpiv.settings.processing import Correlation, Smart
from lfpiv.simulation.camera_images import render_camera
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.velocity.damping import Damping
from lfpiv.velocity.damping_estimate import Simulated, estimate_damping
from lfpiv.velocity.imposed_field import ImposedField
from lfpiv.velocity.settings import CorrelationSettings

ASIDE_VOXEL = 5
"""Width of the lit region beside the volume in realistic images [voxel]."""
SEED = 9_050
"""Seed of pairs that are simulated with the truth."""
TRUTHS = ("flow", "means", "particles")

Images = Mapping[str, np.ndarray]
Noise = Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Vectors of a recorded pair, and the truth along (z, y, x) [voxel]."""

    vectors: xr.Dataset
    exact: np.ndarray


class Rehearsal:
    """Recorded pairs of one case, and simulated ones like them.

    Parameters
    ----------
    case : Case
        Its seed is that of the first pair.
    count : int
        Number of recorded pairs.
    folder : Path
        Images and vectors are stored here.
    """

    def __init__(self, case: Case, count: int, folder: Path):
        self.cases = [replace(case, seed=case.seed + number) for number in range(count)]
        self.folder, self.rig = folder, make_rig(case.scale, case.angles_deg)
        first = self._light(self.cases[0])[0]
        size = measure_size(self.rig.calibration, self.rig.grid, first)
        self.refinement = needed_refinement(size)
        grid = self.rig.grid.padded(_lit_layers(case)).refined(self.refinement)
        self.weights = weights_of(self.rig, grid, (size or 0.0) * self.refinement)
        self.weights.volume = self.rig.grid

    @cached_property
    def solver(self) -> PairSolver:
        return PairSolver(self.weights, SmartSettings(**Smart().of_one_frame(self.refinement)))

    @cached_property
    def pairs(self) -> list[Pair]:
        return [self._measured(case) for case in self.cases]

    @cached_property
    def imitated(self) -> tuple[list[Images], dict[str, float]]:
        """Return the images that show the particles, and the noise of their background."""
        images, noises = [], []
        for case in bootstrap.evenly_spread(self.cases, IMITATED):
            light, noise = self._light(case)
            images, noises = images + light, noises + noise
        return images, {name: float(np.mean([one[name] for one in noises])) for name in noises[0]}

    def measure(self, images: Sequence[Images], noise: Sequence[Noise]) -> xr.Dataset:
        """Measure the vectors between two frames."""
        volumes = [volume_on(one, self.rig.grid) for one in self.solver.solve(images, noise).to_dataarrays()]
        options = Correlation().model_dump() | {"windows": self.cases[0].windows}
        return correlate(*volumes, dt_s=DT_S, **options)

    def damping(self, simulated: int, truths: Sequence[str] = ()) -> Damping:
        """Measure the damping in simulated pairs."""
        images, noise = self.imitated
        volume = self.solver.smart.solve(images[0], floor=noise).volume
        vectors = [pair.vectors for pair in self.pairs]
        if not truths:
            return bootstrap.measure_damping(
                self.weights, vectors, images, self.measure, pairs=simulated, noise=noise, volume=volume
            )
        light = self._lit if "particles" in truths else LightField(self.weights.grid, volume)
        recorded = RecordedImages(self.weights, light)
        particles = recorded.particles(images, noise)
        if "particles" in truths:
            particles = self._true_particles(particles)
        synthetic, found = SyntheticPair(recorded, particles), []
        for number in range(simulated):
            case, pair = self.cases[number % len(self.cases)], self.pairs[number % len(self.cases)]
            flow, exact = make_flow(case), pair.exact
            if "means" in truths:
                flow = ImposedField(pair.vectors, exact)
                exact = flow.window_means
            frames = synthetic.images(flow, np.random.default_rng([SEED, number]))
            found.append(Simulated(vectors=self.measure(frames, (noise, noise)), imposed=exact))
        return estimate_damping(found, vectors)

    def _lit(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the true light of particles: equal in the volume."""
        return lies_in(points_mm, self.rig.grid).astype(float)

    def _true_particles(self, found: RecordedParticles) -> RecordedParticles:
        case, fine = self.cases[0], self.weights.grid.voxel_mm
        size = np.array(SIZE_MM[case.scale])
        count = case.ppm * size[0] * size[1] / VOXEL_MM**2
        density = count / float(np.prod(size)) * fine**3
        return replace(found, density=density, sigma_voxel=case.blob_voxel * VOXEL_MM / fine)

    def _measured(self, case: Case) -> Pair:
        name = "_".join(map(str, (case.label.replace(" ", "_"), case.seed)))
        path = self.folder / "damping" / f"{name}.pickle"
        if not path.exists():
            vectors = self.measure(*self._light(case))
            edge = CorrelationSettings.from_vectors(vectors).windows[-1]
            exact = true_field(case, [vectors[axis].values for axis in "zyx"], edge)[..., ::-1]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps((vectors, exact)))
        vectors, exact = pickle.loads(path.read_bytes())
        return Pair(vectors=vectors, exact=exact)

    def _light(self, case: Case) -> tuple[list[Images], list[Noise]]:
        """Return the images of both frames without dark level and smooth stray light, and their noise."""
        recorded: Recorded = record(case, self.folder / "images")
        stray, images, noises = CONDITIONS[case.condition].stray, [], []
        for frame in recorded.images:
            light = {name: self.rig.light(name, image) for name, image in frame.items()}
            for number, camera in enumerate(self.rig.cameras if stray is not None else ()):
                fixed = np.random.default_rng([case.seed, 33, number])
                lens, _ = stray.fields(light[camera.name].shape, render_camera(camera).pixel_mm, fixed)
                standing = stray.lens_counts * lens * self.rig.white[camera.name]
                light[camera.name] = light[camera.name] - np.float32(standing)
            images.append(light)
            noises.append({name: self.rig.noise(name, image) for name, image in frame.items()})
        return images, noises


def _lit_layers(case: Case) -> Layers:
    """Return guard layers as wide as particles are lit beyond the volume, which a user knows from the light sheet."""
    beyond, depth = CONDITIONS[case.condition].beyond, SIZE_MM[case.scale][2] / VOXEL_MM
    along_z, aside = max(1, round(beyond * depth)), ASIDE_VOXEL if beyond else 1
    return (along_z, along_z), (aside, aside), (aside, aside)


# -- figures, axes in the order x, y, z --------------------------------------------------------------------------------


def slopes(fields: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of measured on true fluctuations of all pairs, and their standard errors (jackknife)."""
    away = [one - one.mean((0, 1, 2)) for one in exact]
    below = np.array([(one**2).sum((0, 1, 2)) for one in away])
    above = np.array([(one * found).sum((0, 1, 2)) for one, found in zip(away, fields, strict=True)])
    without_one = (above.sum(0) - above) / (below.sum(0) - below)
    return above.sum(0) / below.sum(0), np.sqrt((len(above) - 1) * without_one.var(0))


def figures_of(damping: Damping, pairs: Sequence[Pair]) -> dict[str, list[float]]:
    """Compare the damping of simulated and recorded pairs, and vectors without it with raw vectors.

    Returns
    -------
    dict
        `raw`, `raw_error`: slopes of recorded pairs and their standard errors; `simulated`, `simulated_error`: those of
        simulated pairs; `unbiased`: slopes of vectors without damping; `applied`; `error`: mean length of the errors of
        raw vectors and of those without damping [voxel]; `rms_raw`, `rms_unbiased` [voxel]; `within_raw`,
        `within_unbiased`: share of the errors of valid vectors within two stated standard deviations; `deviation`:
        median random deviation of recorded and simulated vectors [voxel].
    """
    whole, exact = [damping.unbiased(pair.vectors) for pair in pairs], [pair.exact[..., ::-1] for pair in pairs]
    axes, figures = [damping.axes[axis] for axis in "xyz"], {}
    lengths = []
    for kind, name, spread in (
        ("raw", "displacement", "uncertainty"),
        ("unbiased", "displacement_unbiased", "uncertainty_unbiased"),
    ):
        fields = [_components(one, name) for one in whole]
        errors = [found - true for found, true in zip(fields, exact, strict=True)]
        valid = [one["valid"].values for one in whole]
        figures[kind], figures[f"{kind}_error"] = (values.tolist() for values in slopes(fields, exact))
        figures[f"rms_{kind}"] = np.sqrt(np.mean([(one**2).mean((0, 1, 2)) for one in errors], axis=0)).tolist()
        within = [
            (np.abs(error) <= 2 * _components(one, spread))[used]
            for error, one, used in zip(errors, whole, valid, strict=True)
        ]
        figures[f"within_{kind}"] = np.concatenate(within).mean(0).tolist()
        lengths.append(float(np.mean([np.linalg.norm(one, axis=-1).mean() for one in errors])))
    figures |= {"simulated": [one.slope for one in axes], "simulated_error": [one.slope_error for one in axes]}
    figures |= {"applied": [float(one.applied) for one in axes], "error": lengths}
    if damping.likeness is not None and (random := damping.likeness.deviation_voxel) is not None:
        figures["deviation"] = [random.recorded, random.simulated]
    return figures


def _components(vectors: xr.Dataset, name: str) -> np.ndarray:
    return np.stack([vectors[f"{name}_{axis}"].values for axis in "xyz"], axis=-1).astype(float)


SHOWN = (
    ("raw", "raw_error"),
    ("simulated", "simulated_error"),
    ("unbiased",),
    ("applied",),
    ("error",),
    ("rms_raw",),
    ("rms_unbiased",),
    ("within_raw",),
    ("within_unbiased",),
    ("deviation",),
)


def show(label: str, figures: Mapping[str, Sequence[float]]) -> None:
    """Print the figures of a case."""
    print(label)
    for names in SHOWN:
        values = [" ".join(f"{value:.3f}" for value in figures.get(name, ())) for name in names]
        print(f"    {names[0]:16s}{' +- '.join(values)}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flows", default="ring,swirl,turbulent:1.33", help="flow, or flow:speed")
    parser.add_argument("--conditions", default="clean", help=", ".join(CONDITIONS))
    parser.add_argument("--angles", default="45,-45", help="angles of the cameras about y [degree]")
    parser.add_argument("--ppm", type=float, default=0.5, help="particles per microlens")
    parser.add_argument("--pairs", type=int, default=32, help="recorded pairs")
    parser.add_argument("--simulated", type=int, default=32, help="simulated pairs")
    parser.add_argument("--seed", type=int, default=101, help="seed of the first recorded pair")
    parser.add_argument("--true", default="", help=f"ingredients of simulated pairs: {', '.join(TRUTHS)}")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images and vectors")
    options = parser.parse_args(arguments)
    angles = tuple(float(angle) for angle in options.angles.split(","))
    truths = tuple(filter(None, options.true.split(",")))
    for condition, named in product(options.conditions.split(","), options.flows.split(",")):
        flow, _, speed = named.partition(":")
        case = Case(
            flow=flow,
            ppm=options.ppm,
            seed=options.seed,
            condition=condition,
            angles_deg=angles,
            speed=float(speed or 1),
        )
        rehearsal, start = Rehearsal(case, options.pairs, options.cache), time.process_time()
        damping = rehearsal.damping(options.simulated, truths)
        label = f"{case.label}, {options.pairs} pairs, {options.simulated} simulated"
        label += f" with true {', '.join(truths)}" if truths else ""
        show(f"{label}, {time.process_time() - start:.0f} s", figures_of(damping, rehearsal.pairs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
