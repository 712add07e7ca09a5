"""Figures of every stage and the self-contained report."""
