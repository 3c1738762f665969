"""Scan matching: the pose in a window that fits a scan best."""

from hsloc.matching.certificate import CertificateParameters, CertificateSummary, certify, summarise
from hsloc.matching.exact import Exact
from hsloc.matching.harmony_search import HarmonySearch
from hsloc.matching.hide import Hide
from hsloc.matching.icp import Icp
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.matching.match import Match, Matcher, StopReason
from hsloc.matching.window import Window

__all__ = [
    "CertificateParameters",
    "CertificateSummary",
    "Exact",
    "HarmonySearch",
    "Hide",
    "Icp",
    "LikelihoodField",
    "Match",
    "Matcher",
    "StopReason",
    "Window",
    "certify",
    "summarise",
]
