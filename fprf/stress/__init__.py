"""Adversarial inputs for every stage, each against a reference and a bound: the report of `fprf bench stress`."""
