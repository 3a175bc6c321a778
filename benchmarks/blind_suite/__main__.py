"""Blind suite of `close_the_loop`: records with sealed effects, solved and scored.

    python -m benchmarks.blind_suite --seed 2 --records 900 --processes 2 --oracle
    python -m benchmarks.blind_suite --seed 1 --records 80 --plant flexible-joint

Records and answers are kept in `--folder` and a run that was stopped goes on where it was. Labels
lie in a file apart, `labels.json`, which only the scorer reads (and the oracle, who is told).
Compiled programs are kept there too, so the times a record are those of a study under way;
`--only KEY` with a fresh folder shows the time of a first call.
Development looks at seed 1, the reported figures come from seed 2. `--only KEY` solves one record;
`--score` only prints.
"""

import os

# One BLAS thread each, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import multiprocessing
import tempfile
from pathlib import Path

from tqdm import tqdm

from benchmarks.blind_suite._answer import answer_job
from benchmarks.blind_suite._generate import Record, generate, load, save
from benchmarks.blind_suite._plants import PLANTS
from benchmarks.blind_suite._score import (
    MAIN,
    breakdown_rows,
    effect_rows,
    metrics,
    pair_rows,
    score_rows,
)
from lpvid.report import text_table


def _answers(path: Path) -> dict[str, dict]:
    if not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text().splitlines() if line]
    return {line["key"]: line for line in lines}


def run(jobs: list, path: Path, processes: int) -> None:
    """Solve what has no answer yet and append the answers, one line each."""
    done = _answers(path)
    kept = sum(job[0].key in done for job in jobs)
    if kept:
        print(f"{kept} answers from earlier runs are kept; --fresh forgets them")
    # By plant, whose programs are compiled once.
    jobs = sorted(
        (job for job in jobs if job[0].key not in done), key=lambda job: job[0].key.rsplit("-", 1)
    )
    if not jobs:
        return
    # Spawned: a process that has started JAX must not be forked.
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes) as pool, path.open("a") as file:
        answers = pool.imap_unordered(answer_job, jobs)
        for answer in tqdm(answers, total=len(jobs), unit="record"):
            file.write(json.dumps(answer) + "\n")
            file.flush()


def _made(arguments) -> tuple[Path, list[Record]]:
    plants = tuple(arguments.plant or PLANTS)
    folder = arguments.folder
    if folder is None:
        names = "-".join(arguments.plant or ["all"])
        name = f"lpvid_blind_{arguments.seed}_{arguments.records}_{names}"
        folder = Path(tempfile.gettempdir()) / name
    if not (folder / "records.npz").exists():
        print(f"Simulating {arguments.records} records into {folder}")
        records, labels = generate(
            arguments.seed, arguments.records, plants=plants, processes=arguments.processes
        )
        save(folder, records, labels)
    return folder, load(folder)


def show(results: dict, labels: dict, oracle: dict | None) -> None:
    """Print the tables."""
    figures = metrics(results, labels, oracle)
    print(f"\n{len(results)} records")
    print(text_table(score_rows(figures), ["metric", "figure", "goal", "met", "of"]))
    print("\nBy plant, noise and loop")
    print(text_table(breakdown_rows(results, labels), ["", "records", *MAIN]))
    print("\nBy effect")
    print(text_table(effect_rows(results, labels), ["truth", "records", "right %", "answers else"]))
    pairs = pair_rows(results, labels)
    if pairs:
        print("\nPairs not named exactly")
        print(text_table(pairs, ["record", "truth", "answer"]))
    failed = {key: r["status"] for key, r in results.items() if r["status"] != "ok"}
    for key, status in list(failed.items())[:10]:
        print(f"{key} failed: {status}")


def main() -> None:
    """Simulate, solve, score."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blind_suite",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--records", type=int, default=900)
    parser.add_argument("--structure", help="for all records; each plant's own by default")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--plant", action="append", choices=list(PLANTS))
    parser.add_argument("--folder", type=Path, help="for records and answers")
    parser.add_argument("--oracle", action="store_true", help="also solve told the effects")
    parser.add_argument("--first", type=int, help="solve only this many")
    parser.add_argument("--only", action="append", metavar="KEY", help="solve this record")
    parser.add_argument("--fresh", action="store_true", help="forget earlier answers")
    parser.add_argument("--score", action="store_true", help="print earlier answers' figures")
    arguments = parser.parse_args()

    folder, records = _made(arguments)
    # Programs recur from record to record; workers that let go of them read them again.
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
    suffix = f"-{arguments.structure}" if arguments.structure else ""
    paths = [folder / f"{kind}{suffix}.jsonl" for kind in ("answers", "oracle")]
    if arguments.fresh:
        for path in paths:
            path.unlink(missing_ok=True)
    chosen = records[: arguments.first]
    if arguments.only:
        chosen = [record for record in records if record.key in arguments.only]
    if not arguments.score:
        run([(record, arguments.structure) for record in chosen], paths[0], arguments.processes)
    labels = json.loads((folder / "labels.json").read_text())
    if arguments.oracle and not arguments.score:
        names = {key: [e["name"] for e in labels[key]["effects"]] for key in labels}
        jobs = [
            (record, arguments.structure, names[record.key])
            for record in chosen
            if labels[record.key]["case"] in ("one", "two")
        ]
        run(jobs, paths[1], arguments.processes)
    keys = {record.key for record in chosen}
    results, oracle = (
        {key: answer for key, answer in _answers(path).items() if key in keys} for path in paths
    )
    if results:
        show(results, labels, oracle)


if __name__ == "__main__":
    main()
