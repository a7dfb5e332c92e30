"""Tables, the database behind them and the archive of raw files; nothing else in the service sees SQL."""
