"""What a study is: its runs, how they are measured, how that is labelled."""
