"""The commands ril-run, ril-report and ril-expert; the only package in `ril/` that uses Hydra."""
