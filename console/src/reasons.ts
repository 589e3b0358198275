// What to do about each reason of a robot's mode (docs/safety.md), by the identifier that robot and documents share.
// A reason that passes by itself has no remedy.

export interface Reason {
  /** The sentence in Portuguese; in English the robot says it itself. */
  readonly pt: string;
  readonly remedy: string;
  readonly remedyPt: string;
}

const reason = (pt: string, remedy = "", remedyPt = ""): Reason => ({ pt, remedy, remedyPt });

export const REASONS: Readonly<Record<string, Reason>> = {
  base_fault: reason("A base tem uma avaria", "Look at the robot, then reset the fault.", "Veja o robô e depois reponha a avaria."),
  bumper: reason("O para-choques está premido", "Free it, then back off or reset the fault.", "Liberte-o e depois recue ou reponha a avaria."),
  cliff: reason("Um sensor não vê o chão", "Carry it to level floor, then reset the fault.", "Leve-o para chão plano e depois reponha a avaria."),
  wheel_drop: reason("Uma roda caiu", "Put it on the floor, then reset the fault.", "Ponha-o no chão e depois reponha a avaria."),
  guardian_lost: reason("Não há ligação ao guardião", "Its computer starts it again; if not: fognav robot bringup on the robot.", "O computador reinicia-o; se não: fognav robot bringup no robô."),
  guardian_silent: reason("O guardião não diz nada", "Its computer starts it again; if not: fognav robot bringup on the robot.", "O computador reinicia-o; se não: fognav robot bringup no robô."),
  wheels_held: reason("O guardião mantém as rodas paradas"),
  wheels_differ: reason("O guardião conta com outras rodas", "Restart both: sudo systemctl restart fognav-watchdog fognav-agent.", "Reinicie ambos: sudo systemctl restart fognav-watchdog fognav-agent."),
  on_dock: reason("Está na base", "Let it leave the dock.", "Mande-o sair da base."),
  battery_low: reason("A bateria está fraca", "Send it to its dock.", "Envie-o para a base."),
  charger_fault: reason("O carregador tem uma avaria", "Look at dock and contacts.", "Veja a base e os contactos."),
  lidar_silent: reason("O lidar não mede nada", "Check its plug and that it turns.", "Verifique a ficha e se ele roda."),
  scan_missing: reason("Falta uma volta completa do lidar", "Check that the lidar turns freely.", "Verifique se o lidar roda livremente."),
  lidar_repeats: reason("O lidar repete as mesmas medidas", "Unplug the lidar and plug it in again.", "Desligue e volte a ligar o lidar."),
  lidar_empty: reason("O lidar roda e não vê nada", "Take away what covers it, or replace it.", "Retire o que o tapa ou substitua-o."),
  at_rest: reason("O lidar descansa", "Send the robot somewhere: it wakes by itself.", "Envie o robô a um destino: acorda sozinho."),
  lidar_blind: reason("O lidar não vê o suficiente", "Clean it, and take away what covers it.", "Limpe-o e retire o que o tapa."),
  obstacle_near: reason("Há um obstáculo mesmo à frente", "Take it away, or wait until it passes.", "Retire-o ou espere que passe."),
  pose_unknown: reason("Não sabe onde está", "Say where it is.", "Diga onde está."),
  pose_lost: reason("Perdeu a sua posição", "Say where it is, then enable it.", "Diga onde está e depois ative-o."),
  pose_uncertain: reason("A sua posição é incerta"),
  position_wide: reason("A sua posição é demasiado incerta", "Say where it is.", "Diga onde está."),
  may_be_blocked: reason("Pode estar numa área bloqueada", "Say where it is.", "Diga onde está."),
  in_blocked: reason("Está numa área ou zona bloqueada", "Let it leave the closed area, or open the area.", "Mande-o sair da área fechada ou abra a área."),
  marker_misplaced: reason("Um marcador está noutro sítio", "Correct the marker in the site's file.", "Corrija o marcador no ficheiro do local."),
  map_missing: reason("Ainda não recebeu o mapa", "See that the map-service runs: fognav status.", "Veja se o serviço de mapas funciona: fognav status."),
  map_late: reason("O mapa chega tarde", "If it stays: check the robot's Wi-Fi.", "Se continuar: verifique o Wi-Fi do robô."),
  map_old: reason("O mapa é antigo", "Check the robot's Wi-Fi and the map-service.", "Verifique o Wi-Fi do robô e o serviço de mapas."),
  map_gap: reason("Faltam alterações do mapa"),
  hazards_old: reason("Não ouve os perigos do nó", "Check the robot's Wi-Fi and the map-service.", "Verifique o Wi-Fi do robô e o serviço de mapas."),
  area_unknown: reason("Está numa área de estado desconhecido", "Look at the area's sensor node.", "Veja o sensor da área."),
  planner_late: reason("O planeador atrasa-se", "If it stays: check the robot's Wi-Fi.", "Se continuar: verifique o Wi-Fi do robô."),
  planner_lost: reason("O planeador não responde", "See that the planner runs: fognav status.", "Veja se o planeador funciona: fognav status."),
  plan_awaited: reason("Espera por um plano no mapa novo"),
  path_awaited: reason("Tem destino, mas ainda não tem percurso"),
  path_of_other_map: reason("O percurso é de outro mapa"),
  path_newer_than_map: reason("O percurso é mais novo do que o mapa"),
  path_refused: reason("Não há percurso até ao destino", "Open what blocks it, or choose another goal.", "Abra o que o bloqueia ou escolha outro destino."),
  path_too_long: reason("O percurso é demasiado longo", "Choose a nearer goal.", "Escolha um destino mais próximo."),
  path_left: reason("Está longe do seu percurso"),
  path_blocked: reason("O percurso está bloqueado mais à frente"),
  no_progress: reason("Não avança", "Take away what is in its way.", "Retire o que está no caminho."),
  no_room: reason("Não tem espaço para virar nem recuar", "Take away what is around it.", "Retire o que está à sua volta."),
  just_started: reason("Acabou de arrancar"),
  not_enabled: reason("Não está ativado", "Enable it.", "Ative-o."),
  recovering: reason("O motivo passou; espera um momento"),
  held_too_long: reason("Esperou mais de 60 s", "Enable it.", "Ative-o."),
  stops_repeated: reason("Parou três vezes num minuto", "Look at the robot, then reset the fault.", "Veja o robô e depois reponha a avaria."),
  maneuver: reason("Faz uma manobra pedida"),
  maneuver_ended: reason("A manobra terminou", "Enable it.", "Ative-o."),
  docking: reason("Vai para a base"),
  docking_given_up: reason("Desistiu de acoplar", "See that the dock is free and has power.", "Veja se a base está livre e tem corrente."),
};
