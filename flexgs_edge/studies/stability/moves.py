"""Experiments on moved scenes: far from the origin, in another unit, turned. Results should hardly change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.camera import Camera, limit_width
from flexgs_edge.cameras.order import farthest_order
from flexgs_edge.errors import FlexGSError
from flexgs_edge.goals.choice import Choice
from flexgs_edge.io.ply import write_ply
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.paper.evaluator import Ranked, SceneEvaluator
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores, ranks_from_order, select_rows
from flexgs_edge.methods.paper.scores import score_scene
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.plots import BarChart
from flexgs_edge.run.few_poses import evenly
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Row, Table, columns
from flexgs_edge.studies.stability.amounts import Amounts
from flexgs_edge.studies.stability.baselines import half_positions
from flexgs_edge.studies.stability.breaks import BREAK, LOST, number
from flexgs_edge.studies.stability.moved_scene import NO_TURN, Similarity
from flexgs_edge.studies.stability.ours import Whole, scored_pixels, walked, whole_at
from flexgs_edge.studies.study_scene import StudyScene
from flexgs_edge.views.bench import Bench

AWAY = np.array([0.6, -0.64, 0.48])
"""Direction of the moves, along no axis."""
STILL = np.zeros(3)
AS_IT_IS = "as it is"
MOVES: dict[str, tuple[Similarity, bool]] = {
    AS_IT_IS: (Similarity(1.0, NO_TURN, STILL), False),
    "moved 1e3, float32": (Similarity(1.0, NO_TURN, 1e3 * AWAY), False),
    "moved 1e3, float64": (Similarity(1.0, NO_TURN, 1e3 * AWAY), True),
    "moved 1e5, float64": (Similarity(1.0, NO_TURN, 1e5 * AWAY), True),
    "moved 1e6, float64": (Similarity(1.0, NO_TURN, 1e6 * AWAY), True),
    "scaled 1e-4": (Similarity(1e-4, NO_TURN, STILL), False),
    "scaled 1e-3": (Similarity(1e-3, NO_TURN, STILL), False),
    "scaled 1e3": (Similarity(1e3, NO_TURN, STILL), False),
    "scaled 1e4": (Similarity(1e4, NO_TURN, STILL), False),
    "turned": (Similarity(1.0, Similarity.drawn(1.0, 5).turn, STILL), False),
}
"""Each move by name, and whether the moved PLY has float64 positions."""
BEST, PAPER, HALF = "best", "paper", "float16 positions"
SAME_KEPT, MORE_BYTES, OTHER_FIDELITY = 0.995, 0.01, 0.1
"""Bounds: least share of equal kept Gaussians, largest relative change of bytes, largest change of fidelity in dB."""


@dataclass(frozen=True)
class Found:
    """Result of a method on a scene: rows kept (ascending; None: all), bytes, and fidelity in dB."""

    rows: np.ndarray | None
    size: int | None
    fidelity: float | None


def moved_file(source: SceneSource, move: Similarity, wide: bool, path: Path) -> SceneSource:
    """The moved scene, written to a PLY and read back, with positions in float32 or, if `wide`, float64."""
    scene = move.scene(source)
    if not wide:
        planes = scene.read(slice(0, scene.count), list(FIELD))
        planes["means"] = (planes["means"].astype(np.float64) + scene.origin[:, None]).astype(np.float32)
        scene = MemorySource(planes, scene.sh_degree)
    write_ply(path, scene, force=True)
    return load_scene(path).source


class Place:
    """A moved scene with its views, ready to be compressed.

    Parameters
    ----------
    studied : StudyScene
        The scene before the move.
    move : Similarity
        The move.
    source : SceneSource
        The moved scene.
    amounts : Amounts
        How many poses, and how wide.
    """

    def __init__(self, studied: StudyScene, move: Similarity, source: SceneSource, amounts: Amounts) -> None:
        self.studied, self.source = studied, source
        train, judges = few_views(studied, amounts)
        cameras = [move.camera(camera) for camera in (*train, *judges)]
        places = list(range(len(cameras)))
        self.views = ViewSet(cameras, None, places[: len(train)], places[len(train) :], "moved", None)
        options = studied.run.options
        assert options.near is not None and options.background is not None and options.extent is not None
        self.renderer = Renderer(
            studied.bench.renderer.backend,
            studied.run.budget,
            options.near * move.factor,
            options.background,
            options.extent,
            bool(options.antialiased),
        )
        self.bench = Bench(self.renderer)

    @contextmanager
    def judge(self) -> Iterator[Judge]:
        """A judge with renders of the moved original."""
        judge = Judge(self.bench, self.source, self.views, self.views.held_out)
        try:
            with self.renderer.load(self.source) as original:
                judge.prepare(original)
            yield judge
        finally:
            judge.close()
            self.renderer.release()

    def best(self, judge: Judge, price: float) -> Found:
        """Compress by best, at a multiplier of `price` times the number of scored pixels."""
        train = self.views.of(self.views.train)
        with walked(self.studied, self.source, train, self.bench) as rounds:
            whole = self.whole(rounds, judge, price * scored_pixels(rounds))
        return Found(whole.rows, whole.size, self._fidelity(judge, whole.source))

    def whole(self, rounds: PruneRounds, judge: Judge, multiplier: float) -> Whole:
        """What the measured method makes at a multiplier."""
        return whole_at(self.studied, rounds, judge, multiplier)

    def paper(self, judge: Judge, choice: Choice) -> Found:
        """Compress by the paper's method at fixed rates, with scores of the moved scene."""
        train = self.views.of(self.views.train)
        with self.renderer.load(self.source) as scene:
            order = order_from_scores(score_scene(self.renderer, scene, self.source, train))
        has_sh = nonzero_sh(self.source)
        bits, groups = self.studied.run.options.bit_spec()
        assert bits is not None
        evaluator = SceneEvaluator(Ranked(self.source, order, has_sh), bits, groups, judge, self.studied.run.budget)
        rows = np.sort(np.concatenate(select_rows(ranks_from_order(order), choice, has_sh)))
        return Found(rows, evaluator.size(choice), evaluator.measure(choice).fidelity)

    def half(self, judge: Judge) -> Found:
        """Only round positions to half precision."""
        return Found(None, None, self._fidelity(judge, half_positions(self.source)))

    def _fidelity(self, judge: Judge, source: SceneSource) -> float | None:
        with self.renderer.load(source) as scene:
            return judge.compare(scene).fidelity


def few_views(studied: StudyScene, amounts: Amounts) -> tuple[list[Camera], list[Camera]]:
    """A few small poses that score, and a few that judge."""
    train, _ = limit_width(studied.views.of(studied.views.train), amounts.few_width)
    judges, _ = limit_width(studied.judge.cameras, amounts.few_width)
    return [train[i] for i in farthest_order(train)[: amounts.few]], evenly(judges, max(amounts.few // 2, 1))


def moves(studied: StudyScene, ours: Whole, amounts: Amounts, folder: Path) -> Experiment:
    """Compare every method on every move with the same method on the scene as it is."""
    train, _ = few_views(studied, amounts)
    price = ours.multiplier / ours.pixels
    rows: list[dict[str, Cell]] = []
    names = (AS_IT_IS, *amounts.moves)
    still: dict[str, Found] = {}
    pictures: list[np.ndarray] = []
    for name in studied.run.progress.track(names, "moves", len(names)):
        move, wide = MOVES[name]
        path = folder / "moved.ply"
        place = Place(studied, move, moved_file(studied.run.source, move, wide, path), amounts)
        with place.judge() as judge:
            seen = [judge.original(i).copy() for i in range(len(judge.cameras))]
            pictures = pictures or seen
            # The moved file has lost precision before any method sees it.
            input_fidelity = mean_psnr([psnr(mse(a, b)) for a, b in zip(seen, pictures)])
            runs: dict[str, Callable[[], Found]] = {
                BEST: lambda: place.best(judge, price),  # noqa: B023
                PAPER: lambda: place.paper(judge, studied.search.chosen.choice),  # noqa: B023
                HALF: lambda: place.half(judge),  # noqa: B023
            }
            for method, run in runs.items():
                try:
                    found = run()
                except FlexGSError as error:
                    rows.append(_failed(name, method, input_fidelity, error))
                    continue
                first = still.setdefault(method, found)
                rows.append(_row(name, method, input_fidelity, first, found))
        path.unlink()
    return _experiment(rows, names, train, len(pictures))


def _row(name: str, method: str, given: float | None, first: Found, found: Found) -> dict[str, Cell]:
    same = None if found.rows is None or first.rows is None else _same(first.rows, found.rows)
    size = None if found.size is None or first.size is None else found.size / first.size - 1
    change = None if found.fidelity is None or first.fidelity is None else found.fidelity - first.fidelity
    within = (
        (same is None or same >= SAME_KEPT)
        and (size is None or abs(size) <= MORE_BYTES)
        and (change is None or abs(change) <= OTHER_FIDELITY)
    )
    broke = LOST if change is not None and change < -BREAK else None
    return {
        "move": name,
        "method": method,
        "given": _rounded(given, 2),
        "same": _rounded(same, 5),
        "size": found.size,
        "bytes_change": None if size is None else round(100 * size, 3),
        "fidelity": _rounded(found.fidelity, 3),
        "change": _rounded(change, 3),
        "within": within,
        "broke": broke,
    }


def _failed(name: str, method: str, given: float | None, error: FlexGSError) -> dict[str, Cell]:
    empty: dict[str, Cell] = dict.fromkeys(("same", "size", "bytes_change", "fidelity", "change"))
    return {
        "move": name, "method": method, "given": _rounded(given, 2), **empty, "within": False, "broke": f"error: {error}",
    }  # fmt: skip


def _same(first: np.ndarray, second: np.ndarray) -> float:
    """Share of rows that are in both lists, of the longer list."""
    return len(np.intersect1d(first, second)) / max(len(first), len(second), 1)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _experiment(rows: list[dict[str, Cell]], names: Sequence[str], train: Sequence[Camera], judges: int) -> Experiment:
    table = Table(
        columns(
            move="move",
            method="method",
            given="fidelity of the moved file (dB)",
            same="share of the kept that are the same",
            size="bytes",
            bytes_change="bytes, change (%)",
            fidelity="fidelity (dB)",
            change="fidelity, change (dB)",
            within="within bounds",
            broke="broken by",
        ),
        tuple(rows),
    )
    methods = (BEST, PAPER, HALF)
    return Experiment(
        "moves",
        "Far from the origin, in other units, turned",
        "The scene is written to a PLY again, moved so many units from the origin (with float32 or float64 "
        "positions), scaled (the near plane alike) or turned (SH too), and compressed: best at one multiplier "
        f"(because where a search stops is partly chance), paper at its rates. Both score {len(train)} poses that are "
        f"{train[0].width} pixels wide, and {judges} judge against the moved scene itself. {HALF}: only positions are "
        "rounded, relative to the world's origin, as published programs do. Fidelity of the moved file compares its "
        "renders with those of the scene as it is, before any method. Within bounds: "
        f"{100 * SAME_KEPT:g} % of the kept Gaussians the same, {100 * MORE_BYTES:g} % of the bytes, "
        f"{OTHER_FIDELITY:g} dB.",
        table,
        BarChart(
            "Fidelity that a move costs",
            "fidelity lost by the move (dB)",
            [name.replace(" ", "\n").replace(",", "") for name in names[1:]],
            {
                method: [
                    None if cell is None else round(-float(cell), 3)
                    for name in names[1:]
                    for cell in table.values("change", move=name, method=method)
                ]
                for method in methods
            },
            limit=BREAK,
            digits=1,
        ),
        (*(_words(rows, method) for method in methods), _files(rows, names)),
    )


def _words(rows: Sequence[Row], method: str) -> str:
    own = [row for row in rows if row["method"] == method and row["move"] != AS_IT_IS]
    outside = [row for row in own if not row["within"]]
    words = []
    for row in outside:
        if row["change"] is None:
            words.append(f"{row['move']} ({row['broke'] or 'nothing to compare'})")
            continue
        kept = "" if row["same"] is None else f"{100 * number(row, 'same'):.2f} % same, bytes {row['bytes_change']} %, "
        words.append(f"{row['move']} ({kept}{number(row, 'change'):+.2f} dB{', broken' if row['broke'] else ''})")
    return f"{method}: {len(own) - len(outside)} of {len(own)} moves within bounds" + (
        f"; not: {', '.join(words)}." if words else "."
    )


def _files(rows: Sequence[Row], names: Sequence[str]) -> str:
    words = []
    for name in names[1:]:
        given = next(row["given"] for row in rows if row["move"] == name)
        words.append(f"{name} {'identical' if given is None else f'{given} dB'}")
    return f"The moved file itself, before any method: {', '.join(words)}."
