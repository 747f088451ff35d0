"""Weakness recognition: how many of a classifier's failures are found in so many calls (chapter 4
of Moss's thesis, and reference figures on the same images).

``python -m benchmarks.weakness [--data FOLDER] [--json] [--quick | --smoke] [--seeds N] [--picture
FILE] [--table | --figures FOLDER]``. With ``--data``: the 10,000 MNIST test images of FOLDER (IDX
files) and the published classifier in it (``sut_784x32x10.npz``: W1, b1, W2, b2), then three
nearest neighbours and a random forest that were trained on the first half of the images and are
validated on the other. Without: scikit-learn's digits, a third to train on and the rest to
validate, and three classifiers, then a table whose failures are two clusters far apart. Means over
seeds, +- one standard error of that mean. "difficulty" is the committee's word before any call;
"pixels" the cross-validated logistic regression on 64 principal components that needs no call
either. Failures found are shares of all of them, at budgets of 5, 10 and 25 % of the inputs; AUC
and precision are those of the final scores on all inputs, where those that were run are judged by
models that have not seen their outcome; candidates: as many as 627 of 10,000. "At most" is what the
random calls guarantee of what is left. Seconds are of one validation, the first with compilation.
"""

import json
from functools import partial
from pathlib import Path

import jax
import numpy as np
from sklearn.decomposition import PCA
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import KFold, cross_val_predict
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier

from benchmarks import weakness_figures
from benchmarks.fms import mean, told
from benchmarks.sizes import options, print_report, printer, size, timed
from jast import plot, weakness
from jast._src.weakness.measures import precision_recall
from jast._src.weakness.thesis_selector import draw_halves
from jast._src.weakness.validation import iteration_key

SHARES = (0.05, 0.1, 0.25)  # of the inputs: budgets
CANDIDATES = 0.0627  # of the inputs, as many as in the thesis
ROWS = ("precision", "recall", "candidates", "calls", "found", "sampled_precision")


class Answers:
    """A classifier, run on everything once: ``predict`` looks its answers up and counts how often
    each input was asked.
    """

    def __init__(self, inputs, predicted):
        self.index = {x.tobytes(): i for i, x in enumerate(inputs)}
        self.predicted = np.asarray(predicted)
        self.asked = np.zeros(len(inputs), int)

    def __call__(self, batch):
        at = np.asarray([self.index[x.tobytes()] for x in batch])
        self.asked[at] += 1
        return self.predicted[at]


def mnist(folder, quick):
    """Name -> (inputs, labels, predictions)."""
    images, labels = weakness.from_idx(folder)
    flat, half = images.reshape(len(images), -1), len(images) // 2
    published = Path(folder) / "sut_784x32x10.npz"
    if published.exists():
        with np.load(published) as w:
            out = np.maximum(flat @ w["W1"] + w["b1"], 0) @ w["W2"] + w["b2"]
        yield "published", images, labels, out.argmax(1)
    if not quick:
        nearest, forest = KNeighborsClassifier(3), RandomForestClassifier(50, random_state=0)
        for name, model in (("nearest", nearest), ("forest", forest)):
            predicted = model.fit(flat[:half], labels[:half]).predict(flat[half:])
            yield name, images[half:], labels[half:], predicted


def digits(quick):
    """The same on scikit-learn's digits."""
    images, labels = weakness.digits()
    order = np.random.default_rng(0).permutation(len(images))
    flat, train, test = images.reshape(len(images), -1), order[:600], order[600:]
    models = {
        "logistic": LogisticRegression(C=0.1, max_iter=500),
        "forest": RandomForestClassifier(30, random_state=0),
        "network": MLPClassifier((32,), max_iter=2000, random_state=0),
    }
    for name, model in list(models.items())[: 1 if quick else 3]:
        predicted = model.fit(flat[train], labels[train]).predict(flat[test])
        yield name, images[test], labels[test], predicted
    if not quick:  # two clusters of failures that no label shows
        x = np.random.default_rng(0).normal(size=(1500, 6)).astype(np.float32)
        classes = (x[:, 0] > 0).astype(int)
        yield "clusters", x, classes, np.where(np.abs(x[:, 3]) > 1.7, 1 - classes, classes)


def ranked(scores, failed):
    """What a ranking by fixed scores finds."""
    order, candidates = np.argsort(-scores, kind="stable"), round(CANDIDATES * len(failed))
    return {
        "found": found(order, failed),
        "auc": weakness.auc(scores, failed),
        "precision": float(failed[order[:candidates]].mean()),
    }


def pixels(images, labels):
    """[n]: 1 - p(true label) of a 5-fold cross-validated logistic regression on 64 principal
    components.
    """
    z = PCA(min(64, images[0].size), random_state=0).fit_transform(images.reshape(len(images), -1))
    model, folds = LogisticRegression(max_iter=300), KFold(5, shuffle=True, random_state=0)
    p = cross_val_predict(model, z, labels, cv=folds, method="predict_proba")
    return 1 - p[np.arange(len(labels)), labels]


def runs(images, labels, predicted, selector, seeds, budget=None):
    """[(result, CPU seconds, wall seconds)], one a seed."""
    out = []
    for seed in range(seeds):
        system = Answers(images, predicted)
        given = dict(budget=budget, selector=selector, classes=int(labels.max()) + 1)
        about = jax.random.key(seed), system, images, labels
        out.append(timed(partial(weakness.validate, *about, **given)))
        if system.asked.max() > 1 or system.asked.sum() != out[-1][0].calls:
            raise AssertionError("an input was asked twice, or a call was not counted")
    return out


def over(rows):
    """Dicts of numbers and lists of them -> the same of means."""
    return {
        k: (
            [mean(c) for c in zip(*(r[k] for r in rows), strict=True)]
            if isinstance(rows[0][k], list)
            else mean([r[k] for r in rows])
        )
        for k in rows[0]
    }


def seconds(done):
    first, *rest = done
    return {
        "seconds_first": first[2],
        "seconds": mean([r[2] for r in rest or done]),
        "cpu_s": mean([r[1] for r in rest or done]),
    }


def found(order, failed):
    """Shares of all failures at the budgets, by the order of the calls."""
    hits = np.cumsum(failed[order])
    return [float(hits[int(len(failed) * s) - 1] / failed.sum()) for s in SHARES]


def adaptive(result, failed):
    """A row of the default selector."""
    judged = weakness.judge(result, failed, top=round(CANDIDATES * len(failed)))
    left = int(failed.sum()) - len(result.failures)
    return dict(
        found=found(result.order, failed),
        auc=judged.auc[-1],
        precision=judged.precision[-1],
        expected=result.expected,
        at_most=result.at_most,
        left=left,
    )


def table(result, failed, replacement):
    """Table 4.1: the means over iterations of precision and recall in the halves that the adversary
    proposes from, of its candidates and of as many chosen there at random.
    """
    rng, rows = np.random.default_rng(0), []
    sample = json.loads(result.state.selector)[1]["sample"]
    for i, scores in enumerate(result.history.scores, 1):
        key = iteration_key(result.state.key, i)
        _, rest = draw_halves(key, len(failed), sample, replacement)
        picked = scores[rest] >= 0.5
        chance = rng.permutation(picked)
        rows.append([precision_recall(p, failed[rest]) for p in (picked, chance)])
    own, chance = np.nanmean(rows, axis=0)
    of_chance = dict(chance_precision=chance[0], chance_recall=chance[1])
    return dict(precision=own[0], recall=own[1]) | of_chance


def tables(systems, seeds, out, say):
    """Table 4.1 without and with replacement, of each system."""
    for name, images, labels, predicted in systems:
        failed = predicted != labels
        for replacement in (False, True):
            chosen = weakness.thesis(replacement=replacement)
            done = runs(images, labels, predicted, chosen, seeds)
            each = []
            for r, *_ in done:
                precision = weakness.judge(r, failed).precision[-1]
                row = table(r, failed, replacement)
                each.append(row | dict(all_precision=precision, calls=r.calls))
            rows = out[f"{name}, replacement={replacement}"] = over(each)
            cells = (f"{k} {told(v, 0 if k == 'calls' else 3)}" for k, v in rows.items())
            say(f"  {name}, replacement={replacement}: {', '.join(cells)}")


def thesis(result, failed):
    """A row of the thesis's adversary: after each iteration, and at its threshold of 0.5 on all
    inputs at the end.
    """
    j, picks = weakness.judge(result, failed), result.history.precision
    row = dict(
        auc=list(j.auc),
        precision=j.precision[-1],
        recall=j.recall[-1],
        candidates=j.candidates[-1],
        calls=result.calls,
    )
    return row | dict(
        found=len(result.failures) / failed.sum(), sampled_precision=np.nanmean(picks)
    )


def line(name, row):
    text = f"  {name:11} {'  '.join(f'{told(f):>14}' for f in row['found'])}"
    if "auc" in row:
        text += f"  {told(row['auc'], 4):>16} {told(row['precision']):>15}"
    if "expected" in row:
        text += (
            f"  expected left {told(row['expected'], 1)}, at most {told(row['at_most'], 1)}, true"
            f" {told(row['left'], 1)};"
            f" {row['seconds_first']:.1f} s, then {told(row['seconds'], 1)} s"
        )
    return text


def study(images, labels, predicted, seeds, quick, picture, say):
    """All rows of one system, printed as they come."""
    failed, budget = predicted != labels, int(len(labels) * SHARES[-1])
    system = images, labels, predicted
    budgets = [f"{int(len(labels) * s)} calls" for s in SHARES]
    say(f"  {'':11} {'  '.join(f'{b:>14}' for b in budgets)}  {'AUC':>16} {'precision':>15}")
    own, chance = runs(*system, "default", seeds, budget), runs(*system, "random", seeds, budget)
    rows = {
        "default": over([adaptive(r, failed) for r, *_ in own]) | seconds(own),
        "difficulty": over([ranked(r.state.memory["difficulty"], failed) for r, *_ in own]),
        "pixels": ranked(pixels(images, labels), failed),
        "random": over([{"found": found(r.order, failed)} for r, *_ in chance]),
    }
    for name, row in rows.items():
        say(line(name, row))
    results = {"default": [r for r, *_ in own], "random": [r for r, *_ in chance]}
    if not quick:
        published = runs(*system, "thesis", seeds)
        rows["thesis"] = t = over([thesis(r, failed) for r, *_ in published]) | seconds(published)
        results["thesis"] = [r for r, *_ in published]
        aucs = " ".join(f"{a['mean']:.3f}" for a in t["auc"])
        say(f"  thesis      AUC {aucs} (the last +- {t['auc'][-1]['se'] or 0:.3f})")
        digits = {name: 0 if name in ("candidates", "calls") else 3 for name in ROWS}
        at_half = ", ".join(f"{name} {told(t[name], digits[name])}" for name in ROWS)
        say(f"              at 0.5: {at_half}")
        say(f"              {t['seconds_first']:.1f} s, then {told(t['seconds'], 1)} s")
    if picture:
        plot.failures_found(results, failed).figure.savefig(picture, dpi=150)
    return rows | {"inputs": len(labels), "failures": int(failed.sum())}


def main(argv=None):
    parser = options(__doc__, "one system, 2 seeds, without the thesis's mode")
    parser.add_argument(
        "--data", help="folder with the MNIST test images and the published classifier"
    )
    parser.add_argument("--seeds", type=int, help="default 10")
    parser.add_argument(
        "--picture", help="draw the first system's failures found against calls into this file"
    )
    parser.add_argument("--table", action="store_true", help="only Table 4.1 of the thesis")
    parser.add_argument(
        "--figures",
        help="only draw figures 4.3 to 4.6 of the thesis into this folder",
    )
    args = parser.parse_args(argv)
    say, out, seeds = printer(args), {}, args.seeds or size(args, 10, 2, 1)
    one = args.quick or args.smoke
    systems = mnist(args.data, one) if args.data else digits(one)
    if args.table:
        tables([next(iter(systems))], seeds, out, say)
        return print_report(args, out)
    if args.figures:
        _, images, labels, predicted = next(iter(systems))
        [(result, *_)] = runs(images, labels, predicted, "thesis", 1)
        networks = weakness.encoded(result, images, labels)
        return weakness_figures.draw(args.figures, result, networks, images, predicted != labels)
    for name, images, labels, predicted in systems:
        if args.smoke:
            images, labels, predicted = images[:80], labels[:80], predicted[:80]
        say(f"{name}: {int(np.sum(predicted != labels))} failures of {len(labels)}")
        picture = None if out else args.picture
        out[name] = study(images, labels, predicted, seeds, args.quick, picture, say)
    print_report(args, out)


if __name__ == "__main__":
    main()
