"""The desk the operator sits at: command line, pipeline, demo and reports."""
