"""Blind suite of the loop: sealed records with known effects, and what their solver is worth."""

from benchmarks.blind_suite._generate import Record as Record
from benchmarks.blind_suite._generate import generate as generate
from benchmarks.blind_suite._generate import load as load
from benchmarks.blind_suite._generate import save as save
