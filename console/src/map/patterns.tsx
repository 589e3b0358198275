// Patterns of hazards and zones, so that their kinds can be told without colours; the style sheet colours them.
const SIZE = 12;

interface Props {
  readonly id: string;
  readonly children: preact.ComponentChildren;
}

function Pattern({ id, children }: Props): preact.JSX.Element {
  return (
    <pattern id={id} width={SIZE} height={SIZE} patternUnits="userSpaceOnUse">
      <rect width={SIZE} height={SIZE} fill-opacity="0.22" />
      {children}
    </pattern>
  );
}

export function Patterns(): preact.JSX.Element {
  return (
    <svg class="patterns" aria-hidden="true">
      <defs>
        <Pattern id="hatch-blocked"><path d="M-3 3 L3 -3 M0 12 L12 0 M9 15 L15 9" stroke-width="4" /></Pattern>
        <Pattern id="hatch-penalty"><path d="M0 0 L12 12 M-3 9 L3 15 M9 -3 L15 3" stroke-width="2" /></Pattern>
        <Pattern id="hatch-slow"><path d="M0 6 H12" stroke-width="2" /></Pattern>
        <Pattern id="dots-unknown"><circle cx="6" cy="6" r="2.5" /></Pattern>
      </defs>
    </svg>
  );
}
