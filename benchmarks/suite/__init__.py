"""Speed against accuracy, beside the engines that a user would pick instead.

``case`` and ``engine`` are the two things that can be added, each by one file under ``cases/`` and ``engines/``;
``plan`` says which of them are measured together, ``measure`` takes the figures, ``store`` keeps them,
``analysis``, ``charts`` and ``report`` read them.
"""
