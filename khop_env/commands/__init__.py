"""What each `khop` command does; `khop_env.cli` puts them together."""
