"""The command line: one module per subcommand, options in, one call down, result out."""
