"""Audits of splits, scores and readers: leaks, shortcuts in scores, and misread columns."""

from deepaccident_devkit.plugins.audit.reader import audit_reader, write_audit_release
from deepaccident_devkit.plugins.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.plugins.audit.scores import audit_scores, read_scores
from deepaccident_devkit.plugins.audit.splits import audit_splits

__all__ = [
    "AuditFinding",
    "AuditReport",
    "audit_reader",
    "audit_scores",
    "audit_splits",
    "read_scores",
    "write_audit_release",
]
