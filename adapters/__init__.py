"""Adapters: one engine a file. Loaded by name through `mbds_xsim.registry`, never imported."""
