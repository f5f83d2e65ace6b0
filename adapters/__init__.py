"""Adapters: one engine a package. Loaded by name through `mbds_xsim.registry`, never imported."""
