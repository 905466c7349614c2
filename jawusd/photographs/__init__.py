"""Estimate the bite from photographs of closed teeth taken with an uncalibrated camera."""
