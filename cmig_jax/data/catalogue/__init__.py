"""Forty categories of generated objects, one module per family; each category is a function of a random generator.

A category draws its proportions and options and returns closed, overlapping solids, z up, x forward. Nearly all have a handle, spout,
door or the like on one side, because the pose of a symmetric object has no single right answer.
"""
