"""The commands ril-run, ril-report and ril-expert; the one package that knows Hydra."""
