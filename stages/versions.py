"""Versions of the stages: raise a stage's number in the commit that changes its results.

A raised number makes every tile built with the old one stale.
"""

FEATURES = 2
TRAINING = 11
EXTRACTION = 2
