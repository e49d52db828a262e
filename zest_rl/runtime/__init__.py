"""Atomic artifacts, parallel work that resumes after an interruption, GL contexts, and the order of imports."""
