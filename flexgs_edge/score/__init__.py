"""Importance scores: reductions over views, one file a family."""

from flexgs_edge.score.cache import ScoreCache, fingerprint
from flexgs_edge.score.files import load_scores, save_scores
from flexgs_edge.score.significance import SCORES, score_scene

__all__ = ["SCORES", "ScoreCache", "fingerprint", "load_scores", "save_scores", "score_scene"]
