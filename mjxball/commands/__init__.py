"""The command lines that join training, export and evaluation. They stand above every other part of the package."""

import os

# XLA writes two lines of 2 kB to stderr for each CPU program that it loads from its cache. What goes wrong is raised.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
