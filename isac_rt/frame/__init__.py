"""What is sent when and by which antenna: the waveform, the payload, the timetable, and the samples
of a frame."""
