"""`tdf evaluate`: how well weights transfer a pose to unseen generated mugs."""

import json
import sys


def evaluate(
    weights: str = "mug",
    pairs: int = 50,
    seed: int = 0,
    height: float = 0.12,
    place: str = "handle",
    inits: int = 10,
    iterations: int = 100,
    random_weights: bool = False,
    json_output: bool = False,
) -> None:
    """Transfer one pose between unseen generated mugs, the target under a uniform random rotation, and print the errors.

    Args:
        weights: a name of shipped weights, or a .safetensors file.
        pairs: mug pairs.
        seed: of the mugs, poses, query points and starts.
        height: of the mugs, metres.
        place: handle, rim or base.
        inits: random starts of each transfer; the one with the least loss counts.
        iterations: Adam steps.
        random_weights: also run the same cases with random weights, which should fail.
        json_output: print JSON instead of a table.
    """
    import dataclasses

    import jax

    from tdf_jax.checkpoint import load_model
    from tdf_jax.errors import InputError
    from tdf_jax.evaluation.cases import mug_case
    from tdf_jax.evaluation.transfer import mean_iou, summary, transfer_errors
    from tdf_jax.network import initialise
    from tdf_jax.optimize import OptimizeConfig

    if pairs < 1:
        raise InputError(f"tdf evaluate: --pairs is {pairs}; expected at least 1")
    if not 0 <= seed < 2**32:
        raise InputError(f"tdf evaluate: --seed is {seed}; expected 0 to {2**32 - 1}")
    if not 0.01 <= height <= 1.0:
        raise InputError(f"tdf evaluate: --height is {height}; expected metres between 0.01 and 1")
    if place not in ("handle", "rim", "base"):
        raise InputError(f"tdf evaluate: --place is {place!r}; expected handle, rim or base")
    models = {weights: load_model(weights)}
    if random_weights:
        model = models[weights]
        models["random weights"] = dataclasses.replace(model, params=initialise(jax.random.key(seed), model.config))
    config = OptimizeConfig(inits=inits, iterations=iterations)
    cases = [mug_case(seed, index, height=height, place=place) for index in range(pairs)]
    rows = {}
    for name, model in models.items():
        errors = transfer_errors(model, cases, seed=seed, config=config)
        rows[name] = {"iou": mean_iou(model, cases)} | summary(*errors, seed)
    if json_output:
        print(json.dumps({"seed": seed, "height": height, "place": place, "weights": rows}, indent=1))
        return
    for name, row in rows.items():
        print(f"{name}: {row['cases']} pairs, {place}, {height:.2f} m mugs, best of {inits} starts by loss")
        print(f"  IoU        {row['iou']:.3f}")
        print(f"  position   median {row['position_median_cm']:.2f} cm, 90 % below {row['position_p90_cm']:.2f} cm")
        print(f"  rotation   median {row['rotation_median_deg']:.1f} deg, 90 % below {row['rotation_p90_deg']:.1f} deg; {row['flips']} flips")
        for key, label in (("1cm_10deg", "1 cm / 10 deg"), ("2cm_20deg", "2 cm / 20 deg")):
            low, high = row[f"interval_{key}"]
            print(f"  success    {row[f'success_{key}']:.0%} at {label} (95 % interval {low:.0%} to {high:.0%})")
    sys.stdout.flush()
