"""Parameters of the human arm by its mass.

The figure shows stiffness and damping of published arms (Table 3.2), divided by the mass of the arm. All arms except
one lie within 710/s² and 14.6/s (dashed). The range of the thesis is 30 % larger (solid). It is γ ≤ 0.001 and δ ≤ 0.02
at T = 1 ms. Kuchenbecker et al. strapped the arm and measured only the hand.
"""

import matplotlib.pyplot as plt

import pipeline

arms = pipeline.human_arms()
stiffness, damping = arms["stiffness"] / arms["mass"], arms["damping"] / arms["mass"]

figure, axes = plt.subplots(figsize=(7, 4.5))
axes.loglog(stiffness, damping, "o")
right = {"Lawrence", "Kuchenbecker et al.", "Daniel et al."}
places = {"Tsuji et al.": (-10, 8), "Lawrence and Chapel": (-20, -14), "Lakatos et al.": (6, -4)}
for source, x, y in zip(arms["source"], stiffness, damping, strict=True):
    side = "right" if source in right else "left"
    place = places.get(source, (-6, -3) if source in right else (6, -3))
    axes.annotate(source, (x, y), place, textcoords="offset points", ha=side)
for k, b, dash, label in ((710, 14.6, "--", "limits (3.15)"), (1000, 20, "-", "range considered (3.17)")):
    axes.plot([0.7, k, k], [b, b, 0.7], dash, color="C2", label=label)
axes.set(xlabel="k/m [1/s²]", ylabel="b/m [1/s]", xlim=(0.7, 2e4), ylim=(0.7, 100))
axes.legend(loc="upper left")
figure.savefig("figure_3_05.svg")
