"""The experiment of Cheng (2023): a robot rotates at a constant -9 deg/s about x.

    python examples/constant_rate.py [--seeds 20] [-o FOLDER]

A 62.5 Hz tracker and a 125 Hz gyroscope measure a joint that first rests, so that the bias can be
measured, then rotates; the tracker is hidden for 0.5 s. For each seed three models estimate the run:
`loose` (recommended), `loose_rate`, and `loose_additive` (that of the paper). `loose` and `loose_additive`
also estimate a run in which the last tracker sample is held during the occlusion, as in the paper. With -o
the figures are drawn.

The last line of the output is JSON. The exit status is 1 if the recommended model misses an expected
value. With --smoke `loose` estimates one seed, and nothing is checked.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxekf
from jaxekf.evaluation import metrics
from jaxekf.recordings.truth import encoder_at, encoder_rate_at
from jaxekf.reporting import plots
from jaxekf.simulation import attitude_runs

REST_S, TURN_S = 60.0, 20.0
OCCLUSION_S = (REST_S + 10.0, REST_S + 10.5)
GRADE = attitude_runs.SensorGrade(bias_walk_deg=0.001)
MODELS = ("loose", "loose_rate", "loose_additive")


def run(seed: int) -> jaxekf.Recording:
    """Simulate one experiment."""
    motion = attitude_runs.constant_rate_motion(-9.0, REST_S)
    return attitude_runs.recording(
        f"seed-{seed}",
        motion,
        seed=seed,
        duration_s=REST_S + TURN_S,
        grade=GRADE,
        occlusions=[OCCLUSION_S],
    )


def held(record: jaxekf.Recording) -> jaxekf.Recording:
    """The same run with the last visible tracker sample held during the occlusion."""
    optical = record.need_optical()
    q = metrics.hold_last(optical, optical.time_ns)
    seen = np.ones(len(q), bool)
    return record.replace(optical=replace(optical, q_ref_body=q, valid=seen))


def parameters(name: str) -> jaxekf.Parameters:
    """The true noise of the sensors, and a large noise of the angular acceleration."""
    params = jaxekf.get_model(name).parameters
    noise = params.noise._replace(bias_walk=np.deg2rad(GRADE.bias_walk_deg))
    if name != "loose":
        noise = noise._replace(acceleration=np.deg2rad(10.0))
    return params._replace(noise=noise)


def measurement_rmse(record: jaxekf.Recording) -> tuple[float, float]:
    """Attitude (deg) and rate (deg/s) RMSE of the raw tracker and gyroscope."""
    encoder, optical, imu = record.need_encoder(), record.need_optical(), record.need_imu()
    seen = optical.valid
    truth = encoder_at(encoder, optical.time_ns[seen])
    attitude = metrics.attitude_error(optical.q_ref_body[seen], truth.q_ref_body)
    rate = imu.gyroscope - encoder_rate_at(encoder, imu.time_ns)
    return float(np.rad2deg(metrics.rms(attitude))), float(np.rad2deg(metrics.rms(rate)))


def occlusion_rmse(estimate: jaxekf.Estimate, record: jaxekf.Recording) -> float:
    """Attitude RMSE in degrees while the tracker is hidden."""
    inside = (estimate.time >= OCCLUSION_S[0]) & (estimate.time < OCCLUSION_S[1])
    truth = encoder_at(record.need_encoder(), estimate.time_ns[inside])
    error = metrics.attitude_error(estimate.attitude.value[inside], truth.q_ref_body)
    return float(np.rad2deg(metrics.rms(error)))


def bias_within(estimate: jaxekf.Estimate, record: jaxekf.Recording) -> np.ndarray:
    """For each axis, whether the final bias is within 2 sigma of the mean at rest."""
    imu = record.need_imu()
    rest = imu.gyroscope[imu.time_ns < imu.time_ns[0] + int(REST_S * 1e9)].mean(axis=0)
    return np.abs(estimate.bias.value[-1] - rest) <= 2.0 * estimate.bias.sigma[-1]


def summarise(name: str, records: list[jaxekf.Recording]) -> dict[str, float]:
    """Means over the seeds for one model."""
    estimates = jaxekf.estimate_many(records, name, parameters(name))
    scores = [jaxekf.score(e, r, burn_in_s=5.0) for e, r in zip(estimates, records, strict=True)]
    pairs = list(zip(estimates, records, strict=True))
    return {
        "attitude_deg": float(np.mean([s.attitude_rmse_deg for s in scores])),
        "rate_deg_s": float(np.mean([s.rate_rmse_deg_s for s in scores])),
        "occlusion_deg": float(np.mean([occlusion_rmse(e, r) for e, r in pairs])),
        "bias_within_2_sigma": float(np.mean([bias_within(e, r) for e, r in pairs])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="number of seeds (20)")
    parser.add_argument("--smoke", action="store_true", help="one seed, only `loose`")
    parser.add_argument(
        "-o", "--output", type=Path, help="folder for the figures of the first seed"
    )
    arguments = parser.parse_args()
    jaxekf.set_up()
    models = MODELS[:1] if arguments.smoke else MODELS
    records = [run(seed) for seed in range(1 if arguments.smoke else arguments.seeds)]
    raw = np.mean([measurement_rmse(record) for record in records], axis=0)
    table = {name: summarise(name, records) for name in models}
    held_records = [held(record) for record in records]
    for name in ("loose", "loose_additive"):
        if name in models:
            table[f"{name}, tracker held"] = summarise(name, held_records)

    print(f"{'':<30}{'attitude':>10}{'rate':>10}{'occluded':>10}{'bias in 2σ':>12}")
    print(f"{'measurement':<30}{raw[0]:>10.4f}{raw[1]:>10.4f}")
    for name, row in table.items():
        share = f"{100 * row['bias_within_2_sigma']:.0f} %"
        print(
            f"{name:<30}{row['attitude_deg']:>10.4f}{row['rate_deg_s']:>10.4f}"
            f"{row['occlusion_deg']:>10.4f}{share:>12}"
        )
    best = table["loose"]
    checks = {
        "attitude below the measurement's": best["attitude_deg"] < raw[0],
        "rate below the measurement's": best["rate_deg_s"] < raw[1],
        "bias within 2 sigma on 90 % of axes": best["bias_within_2_sigma"] >= 0.9,
        "occlusion: masked below held": best["occlusion_deg"]
        < min(row["occlusion_deg"] for name, row in table.items() if "held" in name),
        "occlusion: masked below 0.2 deg": best["occlusion_deg"] < 0.2,
    }
    for text, passed in checks.items():
        print(f"{'ok    ' if passed else 'MISSED'} {text}")
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
        estimate = jaxekf.estimate(records[0], "loose", parameters("loose"))
        for name in plots.available_figures(estimate, records[0]):
            figure = plots.figure_functions()[name](estimate, records[0])
            plots.save(figure, arguments.output / f"{name}.png")
    summary = {"measurement_deg": raw[0], "measurement_deg_s": raw[1], **table}
    print(json.dumps(summary))
    sys.exit(0 if arguments.smoke or all(checks.values()) else 1)


if __name__ == "__main__":
    main()
