"""Writes a file as OGBench has it: an ant that stands at the goal of the second task in a medium maze, or 2 m beside it.

    standing.py FILE
"""
import sys

import numpy

observations = numpy.zeros((120, 29), "f4")
observations[:, :2] = [20, 0]
observations[60:, 1] = 2
observations[:, 2:4] = [0.75, 1]
actions, terminals = numpy.zeros((120, 8), "f4"), numpy.arange(120) % 20 == 19
numpy.savez(sys.argv[1], observations=observations, actions=actions, terminals=terminals)
