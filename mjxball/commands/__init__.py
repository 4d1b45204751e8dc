"""The command lines that join training, export and evaluation. They stand above every other part of the package."""
